from launch import LaunchDescription
from launch.actions import EmitEvent, LogInfo, RegisterEventHandler
from launch.events import matches_action
from launch_ros.actions import LifecycleNode, Node
from launch_ros.event_handlers import OnStateTransition
from launch_ros.events.lifecycle import ChangeState
from lifecycle_msgs.msg import Transition


def generate_launch_description():
    driver = LifecycleNode(package="demo_robot", executable="lidar", name="lidar", namespace="", parameters=[{"port": "/dev/ttyUSB0"}])
    configure = EmitEvent(event=ChangeState(lifecycle_node_matcher=matches_action(driver),
                                            transition_id=Transition.TRANSITION_CONFIGURE))
    activate = EmitEvent(event=ChangeState(lifecycle_node_matcher=matches_action(driver),
                                           transition_id=Transition.TRANSITION_ACTIVATE))
    return LaunchDescription([
        RegisterEventHandler(OnStateTransition(target_lifecycle_node=driver, goal_state="inactive",
                                               entities=[LogInfo(msg="configured"), activate])),
        RegisterEventHandler(OnStateTransition(target_lifecycle_node=driver, goal_state="active",
                                               entities=[Node(package="demo_robot", executable="scan_filter")])),
        driver,
        configure,
        Node(package="nav_demo", executable="lifecycle_manager", name="lifecycle_manager",
             parameters=[{"autostart": True, "node_names": ["lidar"]}]),
    ])
