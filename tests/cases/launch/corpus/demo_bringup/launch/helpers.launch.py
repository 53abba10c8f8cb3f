import functools

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node


def traced(function):
    @functools.wraps(function)
    def inner(*args, **kwargs):
        made = function(*args, **kwargs)
        NODES.append(made)
        return made
    return inner


NODES = []
demo = functools.partial(Node, package="demo_robot", output="screen", emulate_tty=True)


@traced
def node(executable, /, *arguments, rate: int = 10, **parameters):
    merged = {"rate": rate} | parameters
    return demo(executable=executable, arguments=list(map(str, arguments)), parameters=[merged])


def generate_launch_description():
    ld = LaunchDescription()
    ld.add_action(DeclareLaunchArgument("gain", default_value="0.5", description="of the controller"))
    node("reader", 1, 2, rate=5)
    node("writer", gain=LaunchConfiguration("gain"))
    (lambda: node("closer", "--at", 3.5))()
    for made in reversed(NODES):
        ld.add_action(made)
    return ld
