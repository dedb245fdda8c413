"""Where the package's folders lie: three of them at the top; the links in src/spikeloom are for work in a checkout."""

from setuptools import find_namespace_packages, setup

ROOMS = ("compiler", "models", "runtime")

setup(
    packages=[
        "spikeloom",
        *(
            f"spikeloom.{name}"
            for room in ROOMS
            for name in find_namespace_packages(include=[room, f"{room}.*"])
        ),
    ],
    package_dir={"spikeloom": "src/spikeloom"} | {f"spikeloom.{room}": room for room in ROOMS},
)
