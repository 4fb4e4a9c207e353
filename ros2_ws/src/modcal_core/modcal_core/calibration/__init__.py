"""The error model of an arm and the fit of its parameters.

model, parameters, structure: nominal chain, small twists at its places, effects; which of them instruments can show.
initial, starts: base, tool and instruments without a guess.
linearisation, equations: derivatives, sample by sample and in batches, and the steps solved.
fit: ``identify(model, samples, parameters) -> Fit``. noise: the weights of its samples.
cell, distances, known_distances, stated: what is known of the surroundings.
data_split, final_fit: train, explain and held-out; the model to ship.
covariance: how well all of it is known. store, prediction: ``calibration.yaml``, and what is predicted with it.
"""

# ruff: noqa: I001

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from modcal_core.calibration.cell import Cell, StatedPayload, fit_cell, free_cell, own_statement, refit_cell
    from modcal_core.calibration.cell import together_stated, with_frames, with_sockets
    from modcal_core.calibration.covariance import GroupSizes, Identifiability, Uncertainty, identifiability
    from modcal_core.calibration.covariance import likely_sizes, rejected, uncertainty, uncertainty_of, values_without
    from modcal_core.calibration.covariance import with_doubt, without
    from modcal_core.calibration.data_split import SHARES, RejectedPlace, Split, block_length, consecutive, distinct
    from modcal_core.calibration.data_split import hold_out_all, in_order_of_time, independent_unit, places_of, runs_of
    from modcal_core.calibration.data_split import split, station_numbers, units_of_stations
    from modcal_core.calibration.delta_distances import ByDistances, Pairs, Schedule, anneal_distances, by_distances
    from modcal_core.calibration.delta_distances import fit_distances, max_deviations, objective, visibility
    from modcal_core.calibration.distances import AnyDistance, Distance, StationDistance, distance_rows
    from modcal_core.calibration.equations import blocks_at, nonnegative, normal_equations
    from modcal_core.calibration.final_fit import Readmitted, as_used, finalise, readmitted, right_after_all
    from modcal_core.calibration.final_fit import sharpened, uncontradicted
    from modcal_core.calibration.fit import EQUATIONS_PER_PARAMETER, FITTED, WHATS, Curvature, Fit, Move, What
    from modcal_core.calibration.fit import enough_for_effects, identify, identify_moved, priors, require_enough
    from modcal_core.calibration.initial import base_and_tool_turns, base_by_positions, hand_eye, procrustes
    from modcal_core.calibration.initial import tool_and_place, turns_left
    from modcal_core.calibration.placing import Known, find_tool, place_instruments
    from modcal_core.calibration.known_distances import KnownDistance, contradicted_together, contradictions
    from modcal_core.calibration.known_distances import distances_of
    from modcal_core.calibration.linearisation import Deviations, RowView, apply_deviations, deviations, geometry_rows
    from modcal_core.calibration.linearisation import linearise, model_at
    from modcal_core.calibration.model import BLEND, Instrument, Model, between, curved_joints, new_instruments
    from modcal_core.calibration.model import place_model
    from modcal_core.calibration.noise import FINEST, HUBER_Z, REJECT_Z, ErrorSize, Errors, Groups, NoiseModel
    from modcal_core.calibration.noise import as_normal, beyond_chi2, beyond_gumbel, beyond_normal, errors
    from modcal_core.calibration.noise import exceeded_chi2, gumbel_of, has_shared_noise, known_sigma, log10_beyond_f
    from modcal_core.calibration.noise import median_chi2, outlying, quantile_chi2, robust_weights
    from modcal_core.calibration.noise import row_weights, score_of_one, shared_noise, squared_residuals
    from modcal_core.calibration.noise import standard_score, usual_miss, weigh
    from modcal_core.calibration.parameters import INSTRUMENT, PRIOR_ANGLE_RAD, PRIOR_LENGTH_M, ModelParameter, View
    from modcal_core.calibration.parameters import direction_names, drop_fixed, least_change, ordered_candidates
    from modcal_core.calibration.parameters import passing_directions
    from modcal_core.calibration.prediction import averaged, cost_of_holding, outside_drivers, signals_of
    from modcal_core.calibration.starts import fit_geometry
    from modcal_core.calibration.stated import Stated, StatedTool, contradicted_places, stated_std
    from modcal_core.calibration.store import Calibration, fingerprint, from_data, to_data
    from modcal_core.calibration.structure import ParameterChoice, choose_parameters, exact_samples, general_samples
    from modcal_core.calibration.structure import parameter_count, views_of
else:
    from modcal_core.lazy import lazy_face

    __getattr__ = lazy_face(__name__, __file__)
