from glob import glob

from setuptools import find_packages, setup

PACKAGE = "modcal_nodes"

setup(
    name=PACKAGE,
    version="0.1.0",
    description="Nodes around modcal_core (recorder, calibrator, simulated cell), launch files, the modcal command.",
    author="modcal maintainers",
    maintainer="modcal maintainers",
    maintainer_email="maintainers@modcal.example.org",
    license="Apache-2.0",
    packages=find_packages(include=[PACKAGE, f"{PACKAGE}.*"]),
    package_data={"": ["py.typed", "*.xml"]},
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{PACKAGE}"]),
        (f"share/{PACKAGE}", ["package.xml"]),
        (f"share/{PACKAGE}/config", sorted(f for kind in ("yaml", "rviz", "json") for f in glob(f"config/*.{kind}"))),
        (f"share/{PACKAGE}/robots", sorted(glob("robots/*.urdf"))),
        (f"share/{PACKAGE}/launch", sorted(glob("launch/*.launch.py"))),
        ("bin", ["bin/modcal"]),
    ],
    install_requires=["setuptools"],
    extras_require={"test": ["pytest"]},
    zip_safe=False,
    entry_points={
        "console_scripts": [
            f"modcal = {PACKAGE}.cli.main:main",
            f"recorder = {PACKAGE}.nodes.recorder:Recorder.main",
            f"board_detector = {PACKAGE}.nodes.board_detector:BoardDetector.main",
            f"calibrator = {PACKAGE}.nodes.calibrator:Calibrator.main",
            f"corrector = {PACKAGE}.nodes.corrector:Corrector.main",
            f"articulation_estimator = {PACKAGE}.nodes.articulation_estimator:ArticulationEstimator.main",
            f"impedance_setpoint = {PACKAGE}.nodes.impedance_setpoint:ImpedanceSetpoint.main",
            f"acceleration_limits = {PACKAGE}.nodes.acceleration_limits:AccelerationLimits.main",
            f"viewer = {PACKAGE}.nodes.viewer:Viewer.main",
            f"simulated_cell = {PACKAGE}.nodes.simulated_cell:SimulatedCell.main",
            f"simulated_furniture = {PACKAGE}.nodes.simulated_furniture:SimulatedFurniture.main",
            f"door_demo = {PACKAGE}.nodes.door_demo:DoorDemo.main",
            f"station_runner = {PACKAGE}.nodes.station_runner:StationRunner.main",
            f"trajectory_sender = {PACKAGE}.nodes.trajectory_sender:TrajectorySender.main",
        ]
    },
)
