import os

from launch import LaunchDescription
from launch.actions import AppendEnvironmentVariable, GroupAction, SetEnvironmentVariable, UnsetEnvironmentVariable
from launch.substitutions import EnvironmentVariable, LaunchConfiguration
from launch_ros.actions import Node

MODEL = os.environ.get("DEMO_MODEL", "burger")


def generate_launch_description():
    return LaunchDescription([
        SetEnvironmentVariable("RCUTILS_LOGGING_BUFFERED_STREAM", "1"),
        SetEnvironmentVariable(name="DEMO_MODELS", value="/models"),
        AppendEnvironmentVariable("DEMO_MODELS", "/more", separator=":"),
        Node(package="demo_robot", executable="base", parameters=[{"model": MODEL, "who": EnvironmentVariable("DEMO_USER", default_value="x")}],
             additional_env={"DEMO_ONE": "1", "DEMO_NAME": ["m_", MODEL]}),
        GroupAction([
            SetEnvironmentVariable("DEMO_MODELS", [EnvironmentVariable("DEMO_MODELS"), "/inner"]),
            UnsetEnvironmentVariable("RCUTILS_LOGGING_BUFFERED_STREAM"),
            Node(package="demo_robot", executable="inner",
                 arguments=["--mode", LaunchConfiguration("mode", default=EnvironmentVariable("DEMO_MODE", default_value="slow"))]),
        ]),
        Node(package="demo_robot", executable="after"),
    ])
