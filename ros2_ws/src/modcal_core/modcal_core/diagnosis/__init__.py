"""What the model lacks: where the residual sits, in which direction, and on what it depends."""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from modcal_core.diagnosis.causes import Cause, Diagnosis, EvidenceMap, causes_of_moves
    from modcal_core.diagnosis.choice import SIGNIFICANT, EffectChoice, choose, frozen, located, one_motion_names
    from modcal_core.diagnosis.evidence import Scanner
    from modcal_core.diagnosis.hysteresis import last_moves, moments_on_base, paths, since_last, slipped
    from modcal_core.diagnosis.load_hypothesis import by_weight, stated_arm, with_stated
    from modcal_core.diagnosis.loads import Loads, weighed, with_arm
    from modcal_core.diagnosis.residual_curves import with_residual_curves
    from modcal_core.diagnosis.search import Sought, diagnose
    from modcal_core.diagnosis.space import Space
else:
    from modcal_core.lazy import lazy_face

    __getattr__ = lazy_face(__name__, __file__)
