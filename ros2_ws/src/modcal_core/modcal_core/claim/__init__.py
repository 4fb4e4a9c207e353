"""The claim: how far the tool is from where a calibration says, over the postures asked for."""

from modcal_core.claim.claim import Claim, Statistic, claim_at_tool
from modcal_core.claim.neighbourhood import ANGLE_RAD as USUAL_ANGLE_RAD
from modcal_core.claim.neighbourhood import LENGTH_M as USUAL_LENGTH_M
from modcal_core.claim.remedy import OpenDirection
from modcal_core.claim.width import fit_held

__all__ = ["USUAL_ANGLE_RAD", "USUAL_LENGTH_M", "Claim", "OpenDirection", "Statistic", "claim_at_tool", "fit_held"]
