from setuptools import setup

setup(
    name="motion_planning",
    version="0.1.0",
    packages=["motion_planning"],
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/motion_planning"]),
        ("share/motion_planning", ["package.xml"]),
        ("share/motion_planning/launch", ["launch/motion_planning.launch.py"]),
    ],
    install_requires=["setuptools"],
    zip_safe=True,
    description="Motion planning in SE(3) with OMPL: a portfolio of planners, one a process.",
    license="Apache-2.0",
    entry_points={
        "console_scripts": [
            "planner = motion_planning.planner:main",
            "client = motion_planning.client:main",
        ]
    },
)
