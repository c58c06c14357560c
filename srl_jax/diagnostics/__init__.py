"""What a run's latent is like, measured at each evaluation: `diag/...` in the "eval" rows of metrics.jsonl.

    run.py        all diagnostics of one run             heldout.py   the observations that they look at
    measures.py   the measures, of numpy arrays          functions.py the functions of the device
    drift.py      drift, read out of metrics.jsonl       pictures.py  what objectives make of observations

Nothing is drawn from a run's own generators, and nothing that it trains with changes: without diagnostics a
run is the same, to the bit.

Keys, each a number or a list of numbers; null where there is none:

    diag/effective_rank, diag/dormant_share, diag/constant_share     `measures.py`, of the held-out latents
    diag/drift/steps                    env steps of the kept encoders, oldest first; what lists are over
    diag/drift/cosine, diag/drift/cka   latents now against those of each kept encoder
    diag/drift/centred_cosine           the same, what all observations share taken off each latent first
    diag/decoder_now/NAME               error of the decoder of now on latents of each kept encoder and of now
    diag/encoder_now/NAME               error of each kept decoder on latents of now
    diag/error/NAME/moving, .../static  error of the newest frame on pixels that move, and on the others
    diag/error/NAME/moving_explained    1 - that on moving pixels / that of the mean image
    diag/moving_share                   the share of pixels that move
    diag/gradient/NAME/cosine, .../norm_ratio   `functions.make_conflict`, of one batch from replay
    diag/probe/VARIABLE, diag/probe/mean        R^2 of a linear probe for a variable of the game's state
    wall_diag_s                         seconds that all of it took
"""
