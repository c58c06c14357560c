"""How the field plays Atari and what it reports: `--protocol=NAME`, or `PRESET+protocol/NAME`.

A protocol is a dict of `srl_jax.config.Config` fields that say what a score means, and nothing of an agent.
docs/atari100k.md has where each value comes from, and what of a protocol there is not here.
"""

from typing import Any

_COMMON: dict[str, Any] = {
    "sticky_actions": 0.0,
    "full_actions": False,
    "noop_max": 30,
    "life_loss": True,
    "reward_clip": True,
    "eps_eval": 0.001,
    "eval_games": 10,
    "eval_max_steps": 27_000,
    "final_games": 100,
}

PROTOCOLS: dict[str, dict[str, Any]] = {
    # google/dopamine, labs/atari_100k: configs/DER.gin, eval_run_experiment.py (no-ops below 30, 100 games).
    # Kaixhin/Rainbow, env.py, and google-research, bbf/configs/BBF.gin, start and end games likewise.
    "dopamine_100k": _COMMON,
    # mila-iqia/spr, src/rlpyt_atari_env.py (1 to 30 no-ops; 31 is 0 to 30) and src/utils.py (100 games in 100
    # environments).
    "spr_100k": {**_COMMON, "noop_max": 31},
    # Guberina & Desta (2022), table 5.1 and its code: what Config's defaults are.
    "thesis": {**_COMMON, "eps_eval": 0.005, "final_games": 0},
    # Machado et al. (2018), "Revisiting the Arcade Learning Environment": sections 3 to 5.
    "machado": {
        **_COMMON,
        "sticky_actions": 0.25,
        "full_actions": True,
        "noop_max": 0,
        "life_loss": False,
        "eps_eval": 0.01,
        "eval_max_steps": 4_500,
    },
}
"""{name: fields of Config}; all have the same fields."""

PROTOCOLS_HELP = {
    "dopamine_100k": "Atari 100k as Dopamine, BBF and Rainbow's PyTorch code play it",
    "spr_100k": "Atari 100k as SPR's authors play it",
    "thesis": "Guberina & Desta (2022); the defaults",
    "machado": "Machado et al. (2018)",
}
