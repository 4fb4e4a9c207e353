from setuptools import find_packages, setup

PACKAGE = "modcal_msgs_py"

setup(
    name=PACKAGE,
    version="0.1.0",
    description="ROS messages to and from modcal's own arrays, in bags (MCAP) and on the wire. No nodes.",
    author="modcal maintainers",
    maintainer="modcal maintainers",
    maintainer_email="maintainers@modcal.example.org",
    license="Apache-2.0",
    packages=find_packages(include=[PACKAGE, f"{PACKAGE}.*", "modcal"]),
    package_data={"": ["py.typed"]},
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{PACKAGE}"]),
        (f"share/{PACKAGE}", ["package.xml"]),
    ],
    install_requires=["setuptools"],
    extras_require={"test": ["pytest"]},
    zip_safe=False,
)
