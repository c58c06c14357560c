"""srl_jax/loading.py: what another program takes from a run."""

import re
import shutil

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import srl_jax
from srl_jax import plugins
from srl_jax.errors import ConfigError
from srl_jax.window import stack_last
from tests.helpers import JOINT, NUM_ACTIONS, identical, write_checkpoint


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A run directory: two checkpoints, its best, and two encoders that were kept."""
    path = tmp_path_factory.mktemp("runs") / "run"
    for env_steps in (120, 240):
        write_checkpoint(path, env_steps=env_steps, **JOINT)
    write_checkpoint(path, env_steps=160, folder="best", **JOINT)
    write_checkpoint(path, env_steps=0, folder="encoders", only=["encoder"], **JOINT)
    write_checkpoint(path, env_steps=120, folder="encoders", only=["encoder", "reconstruction"], **JOINT)
    return path


@pytest.fixture(scope="module")
def loaded(run):
    return srl_jax.load(run)


def observations(*shape, seed=0):
    return np.random.default_rng(seed).integers(0, 256, (*shape, 42, 42, 4), dtype=np.uint8)


def test_latents_values_and_actions_are_the_agents(loaded):
    x, agent, params = observations(5), loaded.agent, loaded.params
    z = jax.jit(agent.encoder.apply)(params["encoder"], x)
    q = jax.jit(agent.algorithm.q_values)(params["rl"], z)
    np.testing.assert_allclose(loaded.encode(x), z, atol=1e-5)
    np.testing.assert_allclose(loaded.q_values(x), q, atol=1e-5)
    assert loaded.encode(x).dtype == loaded.q_values(x).dtype == np.float32
    actions = loaded.act(x)
    assert actions.dtype == np.int32 and actions.tolist() == np.argmax(q, -1).tolist()
    # What evaluations play has the stacks that environments give.
    frames = np.moveaxis(x, -1, 1)[..., None]
    np.testing.assert_array_equal(stack_last(frames), x)
    assert loaded.policy(jax.random.key(0))(frames, 0, 0.0).tolist() == actions.tolist()


def test_observations_may_have_any_axes_in_front_and_are_bytes_or_in_0_to_1(loaded):
    x = observations(2, 3)
    z = loaded.encode(x)
    assert z.shape == (2, 3, 8) and loaded.q_values(x).shape == (2, 3, NUM_ACTIONS)
    np.testing.assert_allclose(loaded.encode(x[1, 2]), z[1, 2], atol=1e-5)
    assert loaded.act(x[1, 2]).shape == () and loaded.act(x).shape == (2, 3)
    assert loaded.encode(x[:0]).shape == (0, 3, 8)
    np.testing.assert_allclose(loaded.encode(x / np.float32(255)), z, atol=1e-5)


def test_a_function_is_compiled_once_for_a_number_of_observations(loaded):
    before = loaded._q_values._cache_size()
    for seed in range(3):
        loaded.act(observations(7, seed=seed))
    assert loaded._q_values._cache_size() == before + 1


@pytest.mark.parametrize(
    "wrong, given",
    [
        (observations(2)[:, :, :20], r"uint8 \[2, 42, 20, 4\]"),
        (observations(2).astype(float), r"float64 \[2, 42, 42, 4\]"),
        (observations(2)[..., 0], r"uint8 \[2, 42, 42\]"),
    ],
)
def test_other_observations_are_refused(loaded, wrong, given):
    with pytest.raises(ValueError, match=rf"uint8, or float32 in \[0, 1\], \[..., 42, 42, 4\], not {given}$"):
        loaded.encode(wrong)


@pytest.mark.parametrize("make", [np.array, jnp.array])
def test_floats_that_are_bytes_are_refused(loaded, make):
    with pytest.raises(ValueError, match=r"must be in \[0, 1\], not \[0, 255\]; give bytes as uint8$"):
        loaded.encode(make(observations(2), np.float32))
    with pytest.raises(ValueError, match="must be in"):
        loaded.q_values(make(np.full((42, 42, 4), np.nan, np.float32)))
    assert jax.eval_shape(loaded.encode, jnp.zeros((2, 42, 42, 4))).shape == (2, 8)  # traced, nobody knows


def test_epsilon_is_the_share_of_random_actions(loaded):
    x = np.broadcast_to(observations(1), (900, 42, 42, 4))
    greedy = loaded.act(x)
    assert len(set(greedy.tolist())) == 1
    random = loaded.act(x, 1.0, np.random.default_rng(1))
    assert (np.abs(np.bincount(random, minlength=3) - 300) < 60).all()  # four standard deviations
    half = loaded.act(x, 0.5, np.random.default_rng(2))
    assert abs((half != greedy).mean() - 1 / 3) < 0.07
    np.testing.assert_array_equal(half, loaded.act(x, 0.5, np.random.default_rng(2)))
    assert loaded.act(x, 0.5).tolist() != loaded.act(x, 0.5).tolist()
    with pytest.raises(ValueError, match=r"epsilon must be in \[0, 1\], not 2"):
        loaded.act(x, 2)


def test_a_run_one_of_its_checkpoints_and_its_best(run, loaded):
    assert loaded.env_steps == 240 and loaded.config.encoder == "tiny:features=8"
    assert set(loaded.params) == {"encoder", "rl", "reconstruction", "latent_l2"}
    for place, env_steps in (
        ("checkpoints", 240),
        ("checkpoints/000000240", 240),
        ("checkpoints/000000120", 120),
        ("best", 160),
    ):
        there = srl_jax.load(run / place)
        assert there.env_steps == env_steps
        assert identical(there.params, loaded.params) == (env_steps == 240)


def test_kept_encoders_have_no_policy(run, tmp_path):
    first = srl_jax.load(str(run / "encoders" / "000000000"))
    second = srl_jax.load(run / "encoders")
    assert (first.env_steps, second.env_steps) == (0, 120)
    # Those of one env step were written from the same parameters.
    x = observations(2)
    np.testing.assert_array_equal(second.encode(x), srl_jax.load(run / "checkpoints" / "000000120").encode(x))
    assert not np.allclose(first.encode(x), second.encode(x), atol=0.01)
    elsewhere = shutil.copytree(run / "encoders" / "000000000", tmp_path / "elsewhere")
    for there in (second, srl_jax.load(elsewhere)):
        for asked in (there.q_values, there.act, lambda x, p=there.policy: p(jax.random.key(0))):
            with pytest.raises(
                ConfigError, match="no policy was kept there, an encoder alone; name a run that"
            ):
                asked(x)


def test_a_representation_run_has_no_policy(tmp_path):
    write_checkpoint(tmp_path, mode="pretrain", objectives=("latent_l2",))
    loaded = srl_jax.load(tmp_path)
    assert loaded.encode(observations(1)).shape == (1, 8)
    with pytest.raises(ConfigError, match=f"^{re.escape(str(tmp_path))}.*no policy was kept there"):
        loaded.act(observations(1))


def test_what_is_no_checkpoint_is_refused(tmp_path):
    with pytest.raises(ConfigError, match="no checkpoint there; name a run directory or one of its"):
        srl_jax.load(tmp_path)
    with pytest.raises(ConfigError, match="encoder is read by srl_jax.encoders.from_npz"):
        srl_jax.load(tmp_path / "enc.npz")


def test_what_is_loaded_says_what_it_is(loaded):
    assert re.fullmatch(r"<encoder, .*rl of .*, Catch after [\d,]+ env steps>", repr(loaded))


OWN = """
import srl_jax.encoders

@srl_jax.encoders.register("own_for_loading")
def own(shape, *, features: int = 8):
    return srl_jax.encoders.tiny(shape, features=features)
"""


def test_what_a_run_imports_is_imported_first(tmp_path, monkeypatch):
    file, run = tmp_path / "own.py", tmp_path / "run"
    file.write_text(OWN)

    def forget():
        monkeypatch.setattr(plugins, "_LOADED", {})
        srl_jax.encoders.REGISTRY.pop("own_for_loading", None)

    try:
        plugins.load([str(file)])
        write_checkpoint(run, encoder="own_for_loading:features=5", imports=(str(file),))
        forget()
        assert srl_jax.load(run).encode(observations(1)).shape == (1, 5)
        forget()
        with pytest.raises(ConfigError, match="no 'own_for_loading'; valid: nature,"):
            srl_jax.load(run, imports=())
        moved = file.rename(tmp_path / "moved.py")
        with pytest.raises(ConfigError, match=f"^--import={file}: no such file"):
            srl_jax.load(run)
        for imports in ([str(moved)], str(moved), moved):
            assert srl_jax.load(run, imports=imports).encode(observations(1)).shape == (1, 5)
            forget()
    finally:
        forget()
