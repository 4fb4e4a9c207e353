"""The methods: a name, where its code and its packages are, and what a reader should know of it."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Method:
    """call: module and function that answers a task. package: whose version is told. environment: of the requirements
    it needs. about: a sentence for the page.
    """

    call: str
    package: str
    about: str
    environment: str = "common"


METHODS = {
    "modcal": Method("modcal_arm:answer", "modcal", "modcal as it is in this checkout, with all it looks for"),
    "modcal-geometry": Method("modcal_arm:geometry", "modcal", "the same with geometry_only"),
    "nominal": Method("plain:nominal", "numpy", "the maker's arm; base and tool fitted"),
    "offsets": Method("plain:offsets", "scipy", "least squares on zeros, base and tool, as robot_calibration begins"),
    "least-squares": Method("plain:least_squares", "scipy", "least squares on six errors a link, no prior"),
    "mini": Method("mini:answer", "numpy", "ridge on six errors a link, 20 harmonics and a spring a joint"),
    "mini-learned": Method("mini:learned", "numpy", "40 harmonics, their size and that of links learned"),
    "network": Method("residual:network", "scikit-learn", "five small networks on what geometry leaves"),
    "trees": Method("residual:trees", "lightgbm", "boosted trees on what geometry leaves"),
    "gaussian-process": Method(
        "residual:gaussian_process", "scikit-learn", "a Gaussian process on what geometry leaves"
    ),
    "pybotics": Method("pybotics_arm:answer", "pybotics", "DH parameters that the readings tell apart", "pybotics"),
    "figaroh": Method("figaroh_arm:answer", "figaroh", "its own choice of parameters, full_params", "figaroh"),
}

# What was looked for and is not here, with the reason.
MISSING = {
    "robot_calibration, industrial_calibration": "C++ on ROS, not on pip: offsets and least-squares pose its problem",
    "robotkinecal": "not packaged for pip",
    "pyceres": "the same minimum as SciPy's least squares",
    "MUKCa's own code": "not packaged; its formulation is that of the priors here with sockets",
    "kalibr, OpenCV's hand-eye": "there is no camera track",
    "Sturm's articulation": "there is no track of doors",
    "SPI-BoTER, MDH + graph network": "published without code: figures only",
}
