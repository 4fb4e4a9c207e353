"""The error model of an arm and the fit of its parameters.

    model.py, parameters.py      nominal chain, small twists at its places, effects: where the tool is
    structure.py, instruments.py which parameters a robot and an instrument have; identifiability.py: which the data show
    initial.py, locate_instruments.py, closed_form.py    base, tool and instruments without a guess
    linearise.py, kernels/       derivatives, sample by sample and in batches; system.py, normal_equations.py: solved
    identify.py                  the fit: identify(model, samples, parameters) -> Fit; noise.py: its weights
    cell.py, distances.py, sockets.py, stated.py, moves.py    what is known of the surroundings
    split.py, score.py, finalise.py    train, explain and held-out; errors; the model to ship
    uncertainty.py, canonical.py       covariance; parameters written with the least change to the drawing
    store.py, predict.py         calibration.yaml, and what is predicted with it
"""
