from launch import LaunchDescription
from launch.actions import ExecuteProcess, LogInfo, RegisterEventHandler, Shutdown, TimerAction
from launch.event_handlers import OnProcessExit, OnProcessStart, OnShutdown
from launch_ros.actions import Node


def generate_launch_description():
    spawn = Node(package="demo_robot", executable="spawn", arguments=["-entity", "robot"], output="screen")
    broadcaster = Node(package="controller_demo", executable="spawner", arguments=["joint_states", "--controller-manager", "/cm"])
    arm = Node(package="controller_demo", executable="spawner", name="arm", arguments=["arm_controller"])
    check = ExecuteProcess(cmd=["check_robot", "--once"])
    return LaunchDescription([
        RegisterEventHandler(OnProcessExit(target_action=spawn, on_exit=[broadcaster])),
        RegisterEventHandler(event_handler=OnProcessExit(target_action=broadcaster, on_exit=[arm, LogInfo(msg="ready")])),
        RegisterEventHandler(OnProcessStart(target_action=spawn, on_start=check)),
        RegisterEventHandler(OnShutdown(on_shutdown=[LogInfo(msg="bye")])),
        spawn,
        TimerAction(period=5.0, actions=[Node(package="demo_robot", executable="late", on_exit=Shutdown())]),
    ])
