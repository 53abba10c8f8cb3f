from setuptools import setup

setup(
    name="grasp_planning",
    version="0.1.0",
    packages=["grasp_planning"],
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/grasp_planning"]),
        ("share/grasp_planning", ["package.xml"]),
        ("share/grasp_planning/launch", ["launch/grasp_planning.launch.py"]),
    ],
    install_requires=["setuptools"],
    zip_safe=True,
    description="Grasps for a parallel-jaw gripper from a depth image, ranked by a convolutional network.",
    license="Apache-2.0",
    entry_points={
        "console_scripts": [
            "planner = grasp_planning.planner:main",
            "client = grasp_planning.client:main",
        ]
    },
)
