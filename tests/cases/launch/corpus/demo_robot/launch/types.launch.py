from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution, PythonExpression
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import FindPackageShare


def generate_launch_description():
    use_sim_time = LaunchConfiguration("use_sim_time", default="false")
    return LaunchDescription([
        DeclareLaunchArgument("rate", default_value="10"),
        DeclareLaunchArgument("gain", default_value="1e5"),
        DeclareLaunchArgument("empty", default_value=""),
        DeclareLaunchArgument("names", default_value="[a, b]"),
        DeclareLaunchArgument("twice", default_value=LaunchConfiguration("twice", default="2.5")),
        Node(
            package="demo_robot",
            executable="planner",
            name="planner",
            parameters=[{
                "use_sim_time": use_sim_time,
                "rate": LaunchConfiguration("rate"),
                "as_text": ParameterValue(LaunchConfiguration("rate"), value_type=str),
                "as_float": ParameterValue(LaunchConfiguration("rate"), value_type=float),
                "gain": LaunchConfiguration("gain"),
                "empty": LaunchConfiguration("empty"),
                "names": LaunchConfiguration("names"),
                "twice": LaunchConfiguration("twice"),
                "joined": ["frame_", LaunchConfiguration("rate")],
                "several": [[LaunchConfiguration("rate")], ["20"]],
                "mixed": [1, 2.5],
                "plain": "7",
                "deep": {"inner": {"flag": True}, "list": ["a", "b"]},
                "half": PythonExpression([LaunchConfiguration("rate"), " / 4"]),
                "map": PathJoinSubstitution([FindPackageShare("demo_robot"), "maps", "a.yaml"]),
            }],
            arguments=["-d", PathJoinSubstitution([FindPackageShare("demo_robot"), "a.rviz"]), "--rate", LaunchConfiguration("rate")],
        ),
    ])
