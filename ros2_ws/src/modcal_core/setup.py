from setuptools import find_packages, setup

PACKAGE = "modcal_core"

setup(
    name=PACKAGE,
    version="0.1.0",
    description="The mathematics of modcal: kinematics, calibration, diagnosis, reports. NumPy and SciPy only, no ROS.",
    author="modcal maintainers",
    maintainer="modcal maintainers",
    maintainer_email="maintainers@modcal.example.org",
    license="Apache-2.0",
    packages=find_packages(include=[PACKAGE, f"{PACKAGE}.*"]),
    package_data={"": ["py.typed", "*.css", "*.html", "*.j2", "*.js", "*.yaml"]},
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{PACKAGE}"]),
        (f"share/{PACKAGE}", ["package.xml"]),
    ],
    install_requires=["setuptools"],
    extras_require={"test": ["pytest"]},
    zip_safe=False,
)
