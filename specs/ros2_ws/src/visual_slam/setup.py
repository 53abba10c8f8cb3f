from setuptools import setup

setup(
    name="visual_slam",
    version="0.1.0",
    packages=["visual_slam"],
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/visual_slam"]),
        ("share/visual_slam", ["package.xml"]),
        ("share/visual_slam/launch", ["launch/visual_slam.launch.py"]),
    ],
    install_requires=["setuptools"],
    zip_safe=True,
    description="Visual SLAM on RGB-D frames: ORB features, poses from matches, a pose graph.",
    license="Apache-2.0",
    entry_points={
        "console_scripts": [
            "slam = visual_slam.slam:main",
            "client = visual_slam.client:main",
        ]
    },
)
