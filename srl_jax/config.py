"""Every value that determines a run, each with its unit and its limits. Imports no jax.

The command line's flags are generated from the fields of `Config`, so a new value is one new field. The
defaults are those of table 5.1 of the thesis (Guberina & Desta, 2022) and, where the table is silent, of its
code. An "env step" is one decision of the agent, which is four emulator frames on Atari.
"""

import dataclasses
import json
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from srl_jax import checks, envs, specs
from srl_jax.errors import ConfigError
from srl_jax.files import provenance
from srl_jax.files.reading import parse_json, read_json, replace_text
from srl_jax.learning import annealing, modes
from srl_jax.specs import Info

SOURCES = ("encoder_from", "policy_from")
"""The fields that name another run."""

_RENAMED = {"lr_final": "lr_final_share"}
"""Fields of earlier config.json files by the names that they have now."""

FILE = "config.json"

_KINDS = specs.KINDS | {tuple: "a tuple of texts, as ('reconstruction:weight=1',)"}
"""What each kind of value is called in an error."""


def _value(kind: type, default: Any, help: str, unit: str = "", **limits: Any) -> Any:
    return dataclasses.field(default=default, metadata={"info": Info(kind, help, unit, **limits)})


def _steps(default: int, help: str, minimum: int = 1, unit: str = "env steps") -> Any:
    return _value(int, default, help, unit, minimum=minimum)


def _share(default: float, help: str, unit: str = "probability") -> Any:
    return _value(float, default, help, unit, minimum=0, maximum=1)


@dataclasses.dataclass(frozen=True)
class Config:
    """Every value that determines a run, checked on construction; `srl-jax train --help` says what each is.

    Raises:
        ConfigError: a value is of the wrong type or out of its limits; one line that names the
            flag.
    """

    game: str = _value(
        str, "Pong",
        "an Atari-57 game, Catch, CatchDistractor, catch:ball=2,background=moving, gymnasium:id=Name-v0, or "
        "module:Name-v0, which imports the module",
    )  # fmt: skip
    mode: str = _value(
        str, "rl_only", "; ".join(f"{m.name}: {m.help}" for m in modes.MODES.values()),
        choices=tuple(modes.MODES),
    )  # fmt: skip
    rl: str = _value(
        str, "rainbow",
        "RL algorithm, name:key=value,...; :key=value,... changes options of the preset's algorithm",
    )  # fmt: skip
    encoder: str = _value(
        str, "nature",
        "encoder that all losses share, name:key=value,...; :key=value,... changes options of the preset's "
        "encoder",
    )  # fmt: skip
    objectives: tuple[str, ...] = _value(
        tuple, (),
        "representation loss, name:key=value,...; may be repeated; none stands for no loss; beside a preset, "
        "+name:... adds a loss or replaces the one of that name, and -name leaves that one out; weight=2, "
        "'weight=1->0.01@200000' (linear over env steps) or weight=ratio:0.1 (a tenth of RL's gradient)",
        flag="objective",
    )  # fmt: skip
    augment: str = _value(
        str, "none", "which losses see randomly shifted frames; srl: the representation losses",
        choices=("none", "srl", "all"),
    )  # fmt: skip
    rl_view: str = _value(
        str, "",
        "what RL sees: none, or shift, intensity, crop_pad_crop, several with +, one draw a sequence; "
        "@each behind it: a draw for each observation; empty: what --augment says",
    )  # fmt: skip
    srl_view: str = _value(
        str, "", "what the representation losses see, likewise; one draw with --rl_view where both are alike"
    )
    target_view: str = _value(
        str, "same",
        "what targets see: slow encoders, and RL of s_{t+n}; by a draw of their own; same: each loss's view",
    )  # fmt: skip
    srl_every: int = _value(
        int, 1, "representation losses are computed in every k-th update", "updates", minimum=1
    )
    encoder_optimizer: str = _value(
        str, "separate",
        "how the encoder is stepped where RL and representation both train it; separate: RL's Adam steps, "
        "then the representation's own Adam on a fresh encoding, as in the thesis' code; simultaneous: both "
        "Adams take gradients at the same parameters; summed: one Adam steps on the summed loss",
        choices=modes.ENCODER_OPTIMIZERS,
    )  # fmt: skip
    gate: str = _value(
        str, "sum",
        "how the gradients of RL and representation meet in an encoder that both train; "
        + "; ".join(f"{name}: {help}" for name, help in modes.GATES.items()),
        choices=tuple(modes.GATES),
    )  # fmt: skip
    target_encoder: str = _value(
        str, "slow", "encoder under the target network: its slow copy, or the online encoder",
        choices=("slow", "online"),
    )  # fmt: skip
    seed: int = _value(int, 0, "seed of all random numbers", minimum=0, maximum=2**31 - 1)

    steps: int = _steps(5_000_000, "length of the run")
    num_envs: int = _value(
        int, 10, "training environments; each takes one env step in a round of the loop", "environments",
        minimum=1, maximum=10_000,
    )  # fmt: skip
    buffer_size: int = _steps(100_000, "capacity of the replay buffer", unit="transitions")
    batch_size: int = _steps(32, "batch of one update", unit="transitions")
    updates_per_step: float = _value(
        float, 0.1, "gradient updates for each env step", "updates per env step", minimum=1e-6, maximum=1_000
    )
    learn_start: int = _steps(320, "env steps before the first update", minimum=0)
    gamma: float = _share(0.99, "discount", "per env step")
    gamma_anneal: str = _value(
        str, "",
        "'0.97->0.997@10000': over so many updates after each reset, or the start, 1 - gamma goes "
        "exponentially to that of --gamma; empty: gamma stays",
    )  # fmt: skip
    n_anneal: str = _value(
        str, "",
        "'10->3@10000': likewise n, rounded, of which the larger is --rl's n_step; empty: n stays",
    )  # fmt: skip
    reset: str = _value(
        str, "none",
        "what is drawn anew in the run, with its slow copies and Adam's moments; head: RL's; head_last: its "
        "layers behind the hidden ones; all: all heads, and the encoder and SPR's transition are shrunk",
        choices=("none", "head", "head_last", "all"),
    )  # fmt: skip
    reset_every: int = _steps(0, "env steps between two resets", minimum=0)
    reset_last: int = _steps(0, "env step after which there is no reset; 0: they go on", minimum=0)
    shrink: float = _share(
        0.5, "share of encoder and transition that --reset=all leaves, beside fresh parameters; 1 leaves all",
        "share",
    )  # fmt: skip

    lr_rl: float = _value(float, 1e-4, "Adam's learning rate of the RL head", minimum=0)
    lr_srl: float = _value(float, 1e-4, "Adam's learning rate of the representation heads", minimum=0)
    lr_encoder: float = _value(
        float, 0.0,
        "Adam's learning rate of the encoder; 0: lr_rl where RL trains it, otherwise lr_srl",
        minimum=0,
    )  # fmt: skip
    lr_encoder_srl: float = _value(
        float, 0.0,
        "learning rate of the representation's Adam of the encoder, where the encoder has two; 0: lr_srl",
        minimum=0,
    )  # fmt: skip
    lr_final_share: float = _share(
        1.0, "share of each learning rate that is left at the end of the run; rates fall linearly", "share"
    )
    decoder_weight_decay: float = _value(
        float, 1e-7, "L2 weight decay of the decoders, added before Adam's scaling", minimum=0
    )
    weight_decay: float = _value(
        float, 0.0,
        "AdamW's decoupled weight decay of all that is trained and has more than one axis, per learning rate",
        minimum=0,
    )  # fmt: skip
    max_grad_norm: float = _value(
        float, 0.0, "global norm that gradients are clipped to; 0: no clipping", minimum=0
    )
    adam_eps: float = _value(float, 1e-8, "Adam's epsilon", minimum=1e-37)

    beta: float = _share(0.4, "exponent of the importance weights at the start", "exponent")
    beta_final: float = _share(1.0, "exponent of the importance weights at the end", "exponent")
    beta_anneal_steps: int = _steps(5_000_000, "length of beta's linear schedule")
    eps_train: float = _share(1.0, "epsilon of the behaviour policy at the start")
    eps_final: float = _share(0.05, "epsilon of the behaviour policy at the end")
    eps_anneal_steps: int = _steps(1_000_000, "length of epsilon's linear schedule")
    eps_eval: float = _share(0.005, "epsilon in evaluations")
    slow_update_every: int = _steps(
        500,
        "RL's slow copies are replaced in every k-th update, where --rl has slow=periodic",
        unit="updates",
    )

    eval_every: int = _steps(100_000, "env steps between two evaluations of the policy (one epoch)")
    eval_games: int = _value(int, 10, "full games in one evaluation", "games", minimum=1)
    eval_max_steps: int = _value(
        int, 27_000, "length at which an evaluation game is cut (27,000 are 108,000 frames)", "env steps",
        minimum=1, maximum=specs.LIMITS[int] // envs.FRAME_SKIP,
    )  # fmt: skip
    final_games: int = _value(
        int, 0, "full games after the last env step, in a row of kind final; 0: none", "games",
        minimum=0, maximum=1_000_000,
    )  # fmt: skip
    eval_envs: int = _value(
        int, 0, "environments that play an evaluation's games at once, one game or more each; 0: --num_envs",
        "environments", minimum=0, maximum=10_000,
    )  # fmt: skip
    stop_at_return: float | None = _value(
        float, None, "mean evaluation return at which the run ends early, or off", "unclipped score",
        optional=True,
    )  # fmt: skip
    log_every: int = _steps(1_000, "env steps between two train rows of metrics.jsonl")
    checkpoint_every: int = _steps(
        0, "env steps between two checkpoints; 0: as often as evaluations", minimum=0
    )
    keep_encoder_every: int = _value(
        int, 0, "the encoder of every k-th checkpoint is kept in encoders/; 0: none is", "checkpoints",
        minimum=0,
    )  # fmt: skip
    keep_best: bool = _value(bool, True, "keep the parameters of the best evaluation so far in best/")
    keep_replay: bool = _value(
        bool, False, "keep replay in the last checkpoint, so that a finished run can be extended"
    )
    diagnostics: bool = _value(
        bool, True, "measure the latent at each evaluation: drift, rank, gradient conflict, probes"
    )
    diagnostics_kept: int = _value(
        int, 10, "epochs whose encoders and decoders are kept in encoders/, to measure drift against",
        "epochs", minimum=0, maximum=1_000,
    )  # fmt: skip
    loggers: tuple[str, ...] = _value(
        tuple, (),
        "where rows go beside metrics.jsonl: tensorboard, wandb, csv, or module:Logger, a class of your own "
        "(see srl_jax/files/loggers.py); may be repeated, or a list with commas; none stands for no logger",
        flag="logger",
    )  # fmt: skip

    reward_clip: bool = _value(bool, True, "learn from the sign of the reward")
    life_loss: bool = _value(bool, True, "a lost life ends the return, but not the game, in training")
    sticky_actions: float = _share(0.0, "the emulator repeats the last action with this probability")
    full_actions: bool = _value(
        bool, False, "all 18 actions of the joystick, instead of those that the game knows (Atari)"
    )
    noop_max: int = _value(
        int, 30, "a game starts with fewer random no-ops than this", "emulator frames",
        minimum=0, maximum=1_000,
    )  # fmt: skip
    frame_size: int = _value(
        int, 84,
        "height and width that frames are resized to; 0: as large as the gymnasium environment's own; Catch "
        "has 42 and 84",
        "pixels", minimum=0, maximum=1_024,
    )  # fmt: skip
    frame_stack: int = _value(int, 4, "frames in one observation", "frames", minimum=1, maximum=256)

    encoder_from: str = _value(str, "", "run directory or checkpoint whose encoder this run starts from")
    heads_from: str = _value(
        str, "representation",
        "heads that also start from --encoder_from, where both runs have them; representation: decoders and "
        "other representation heads; all: RL's head, too",
        choices=("representation", "all", "none"),
    )  # fmt: skip
    policy_from: str = _value(
        str, "", "run directory or checkpoint whose policy acts in --mode=pretrain; empty: a random policy"
    )
    pretrain_epsilon: float = _share(0.3, "epsilon of the behaviour policy in --mode=pretrain")
    imports: tuple[str, ...] = _value(
        tuple, (),
        "file (my_file.py) or module that registers objectives, encoders, RL algorithms or loggers of your "
        "own, see srl_jax/plugins.py; may be repeated",
        flag="import",
    )  # fmt: skip

    def __post_init__(self):
        for name, info in INFOS.items():
            value = getattr(self, name)
            if info.kind is tuple and isinstance(value, list):
                value = tuple(value)
                object.__setattr__(self, name, value)
            # JSON and people write 1 for 1.0; one type keeps the round trip exact.
            if info.kind is float and type(value) is int and abs(value) <= specs.LIMITS[float]:
                value = float(value)
                object.__setattr__(self, name, value)
            right_type = type(value) is info.kind or (info.optional and value is None)
            if right_type and info.kind is tuple:
                right_type = all(type(element) is str for element in value)
            flag = info.flag or name
            if not right_type:
                raise ConfigError(f"--{flag}={value!r}: not {_KINDS[info.kind]}")
            if isinstance(value, float) and not abs(value) < float("inf"):
                raise ConfigError(f"--{flag}={value}: not a finite number")
            try:
                info.check(value)
            except ValueError as error:
                raise ConfigError(f"--{flag}={value}: {error}") from None
        self._check_together()

    def _check_together(self) -> None:
        # A row of what is imported later is known by then, see `resolve`.
        game = envs.known(self.game) if self.imports else envs.game(self.game)
        if not (self.frame_size or game.own_size):
            raise ConfigError(f"--frame_size=0: --game={self.game} has no size of its own; give one, say 84")
        sizes = game.frame_sizes
        if sizes and self.frame_size not in sizes:
            known = " and ".join(map(str, sizes))
            raise ConfigError(f"--frame_size={self.frame_size}: --game={self.game} knows {known}")
        for name in ("batch_size", "learn_start"):
            if getattr(self, name) > self.buffer_size:
                value = f"--{name}={getattr(self, name)}"
                raise ConfigError(f"{value}: must be at most --buffer_size={self.buffer_size}")

    def to_json(self) -> str:
        """The fields as an indented JSON object; `from_json` gives this Config again, exactly."""
        return json.dumps(dataclasses.asdict(self), indent=2)

    @classmethod
    def from_json(cls, text: str | bytes) -> "Config":
        """Reads `to_json`'s text, or a run's config.json; see `from_values`."""
        try:
            return cls.from_values(parse_json(text))
        except ConfigError:
            raise
        except ValueError as error:
            raise ConfigError(f"config: not JSON: {error}") from None

    @classmethod
    def from_values(cls, values: Any) -> "Config":
        """A Config from its fields, and what else config.json has. A missing field takes its default.

        Raises:
            ConfigError: not a JSON object, an unknown field, or a value out of its limits.
        """
        if not isinstance(values, dict):
            raise ConfigError("config: not a JSON object")
        values = {_RENAMED.get(name, name): x for name, x in values.items() if name not in provenance.ABOUT}
        if values.pop("tensorboard", False):  # before there were loggers
            values.setdefault("loggers", ["tensorboard"])
        for name in values:
            if name not in INFOS:
                raise ConfigError(f"config: no field {name!r}; {specs.choices_text(name, INFOS)}")
        return cls(**values)

    @classmethod
    def load(cls, run: str | Path) -> "Config":
        """Reads config.json of a run directory; raises as `read`."""
        return read(run)[0]

    def whole_rounds(self, env_steps: int) -> int:
        """The first env step not before this one that ends a round of the training environments."""
        return -(-env_steps // self.num_envs) * self.num_envs

    def save(self, run: str | Path, seeds: Sequence[int] = ()) -> None:
        """Writes a run's config.json: fields, what made the run, when it began (UTC), seeds in step."""
        made = {**provenance.made_by(self.imports), "started": provenance.now()}
        write(run, {**dataclasses.asdict(self), **made, **({"seeds": list(seeds)} if seeds else {})})


def read(run: str | Path) -> tuple[Config, dict[str, Any]]:
    """What config.json of a run directory says: the settings, and all of its content.

    Raises:
        ConfigError: there is none, or it is not a Config.
    """
    path = Path(run) / FILE
    try:
        about = read_json(path)
    except ConfigError as error:
        hint = "; not a run directory" if isinstance(error.__cause__, OSError) else ""
        raise ConfigError(f"{error}{hint}") from None
    try:
        return Config.from_values(about), about
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from None


def write(run: str | Path, about: Mapping[str, Any]) -> None:
    """Writes all of a run's config.json."""
    replace_text(Path(run) / FILE, json.dumps(about, indent=2) + "\n")


INFOS: dict[str, Info] = {f.name: f.metadata["info"] for f in dataclasses.fields(Config)}
"""The fields of Config, in order."""


def resolve(
    config: Config,
    rl_registry: Mapping[str, Callable],
    encoder_registry: Mapping[str, Callable],
    objective_registry: Mapping[str, Callable],
    given: Collection[str] = (),
) -> Config:
    """Writes out everything that the config leaves to a default: all options, rates and intervals.

    A game gets its canonical name, see `srl_jax.envs.canonical`, and what nothing reads its default.

    Args:
        config: a run's.
        rl_registry, encoder_registry, objective_registry: name -> factory.
        given: fields and options that were given and have to be read.

    Returns:
        A Config that resolves to itself; what config.json holds.

    Raises:
        ConfigError: a specification is not valid, or nothing reads what was given; names the flag.
    """
    rl = specs.parse(config.rl, rl_registry, "rl")
    encoder = specs.parse(config.encoder, encoder_registry, "encoder")
    objectives = tuple(specs.parse(text, objective_registry, "objective") for text in config.objectives)
    for objective in objectives:
        if [other.name for other in objectives].count(objective.name) > 1:
            raise ConfigError(f"--objective={objective}: {objective.name} is given twice")
    run = checks.run_of(config, rl=rl, objectives=objectives)
    run.refuse(given)
    config = run.in_force()
    rl = specs.parse(config.rl, rl_registry, "rl")  # where RL is not trained, the default
    run = run._replace(config=config, rl=rl)
    rl, encoder, *terms = (run.spec_in_force(spec, given) for spec in (rl, encoder, *objectives))
    if config.n_anneal:
        annealing.check_n(config.n_anneal, rl)
    return dataclasses.replace(
        config,
        game=envs.canonical(config.game),
        rl=rl.full,
        encoder=encoder.full,
        objectives=tuple(term.full for term in terms),
        n_anneal=annealing.written(config.n_anneal, int),
        gamma_anneal=annealing.written(config.gamma_anneal, float),
        lr_encoder=modes.encoder_learning_rate(config),
        lr_encoder_srl=modes.second_learning_rate(config),
        checkpoint_every=config.checkpoint_every or config.eval_every,
    )


def unresolved(config: Config) -> Config:
    """The config with 0 where `resolve` would put the value that is there: it follows other fields again."""
    defaults: dict[str, Any] = {name: 0 for name in ("lr_encoder", "lr_encoder_srl", "checkpoint_every")}
    bare = dataclasses.replace(config, **defaults)
    followed = {
        "lr_encoder": modes.encoder_learning_rate(bare),
        "lr_encoder_srl": modes.second_learning_rate(bare),
        "checkpoint_every": config.eval_every,
    }
    same: dict[str, Any] = {name: 0 for name, value in followed.items() if getattr(config, name) == value}
    return dataclasses.replace(config, **same)


def difference(there: Config, here: Config, names: Iterable[str] = tuple(INFOS)) -> str:
    """What differs of these fields, `steps is 1000 there and 2000 here, ...`; "" if nothing."""
    pairs = ((name, getattr(there, name), getattr(here, name)) for name in names)
    return ", ".join(f"{name} is {a} there and {b} here" for name, a, b in pairs if a != b)
