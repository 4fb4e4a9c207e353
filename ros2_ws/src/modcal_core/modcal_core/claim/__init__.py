"""The claim: how far the tool is from where a calibration says, over the postures asked for."""

from modcal_core.claim.claim import Claim, Statistic, claim_at_tool, expected_claim
from modcal_core.claim.evidence import draw, usual_std
from modcal_core.claim.neighbourhood import ANGLE, FREE, LENGTH, ArmEvidence, Neighbourhood, arms_near
from modcal_core.claim.remedy import OpenDirection
from modcal_core.claim.width import fit_held, settled

__all__ = ["ANGLE", "FREE", "LENGTH", "ArmEvidence", "Claim", "Neighbourhood", "OpenDirection", "Statistic"]
__all__ += ["arms_near", "claim_at_tool", "draw", "expected_claim", "fit_held", "settled", "usual_std"]
