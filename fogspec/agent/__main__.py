"""Run one of the agent's programs: `python3 agent.pyz PROGRAM [OPTIONS]`."""

import argparse
import importlib
import sys

PROGRAMS = {
    "sample": "measure one sample: start its processes, watch their requests, stop, write the outcome",
    "supervisor": "run the nodes of a deployment until one of them ends, and report their state",
    "declared": "ask nodes whether they declare the parameters that the spec sets",
    "activate": "configure and activate managed nodes, and again those that were started again",
    "topics": "time requests on ROS 2 topics and goals of an action, beside the nodes",
    "preload": "start a node with the timing library in its process",
    "launch": "have ROS 2's launch play a launch file that is given as text",
    "bag": "time the requests in a recorded bag",
    "player": "send the requests of a recorded bag",
    "watch": "watch the graph of a robot that runs, without changing it, or record topics",
    "redaction": "copy standard input without the values of secret variables",
}


def main() -> None:
    """Run the program that the first argument names with the arguments after it."""
    width = max(map(len, PROGRAMS))
    parser = argparse.ArgumentParser(
        prog="agent.pyz",
        description="What fogspec runs on a machine. It opens no port.",
        epilog="programs:\n" + "\n".join(f"  {name:<{width}}  {purpose}" for name, purpose in PROGRAMS.items()),
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("program", choices=PROGRAMS, metavar="PROGRAM", help="PROGRAM --help lists its options")
    program = parser.parse_args(sys.argv[1:2]).program
    module = importlib.import_module(f"{__package__}.{program}")
    sys.exit(module.main(sys.argv[2:]))


if __name__ == "__main__":
    main()
