"""The error model of an arm and the fit of its parameters.

model, parameters: nominal chain, small twists at its places, effects; together where the tool is.
structure, instruments, identifiability: which parameters a robot and an instrument have, and which the data show.
initial, locate_instruments, closed_form: base, tool and instruments without a guess.
linearise, kernels: derivatives, sample by sample and in batches. system, normal_equations: the steps solved.
identify: the fit, ``identify(model, samples, parameters) -> Fit``. noise: the weights of its samples.
cell, distances, sockets, stated, moves: what is known of the surroundings.
split, score, finalise: train, explain and held-out; errors; the model to ship.
uncertainty, canonical: covariance; parameters written with the least change to the description.
store, predict: ``calibration.yaml``, and what is predicted with it.
"""
