"""The program: `fogspec`, or `python -m fogspec`."""

import atexit
import gc
import importlib
import os
import sys


def main(command_line: str = "fogspec.cli") -> None:
    """Run `main` of a module; Ctrl-C while it is being loaded ends without a traceback."""
    # Modules, types and documents stay until the end. To search them for garbage takes a fifth of a command's time.
    gc.set_threshold(200_000)
    atexit.register(gc.freeze)
    # Otherwise pydantic opens every installed distribution to look for plugins of its own, of which fogspec uses none.
    os.environ.setdefault("PYDANTIC_DISABLE_PLUGINS", "__all__")
    try:
        from fogspec.base import child

        child.leave_working_folder()
        child.without_home()
        child.use_one_thread()
        module = importlib.import_module(command_line)
    except KeyboardInterrupt:
        sys.exit(130)
    module.main()


if __name__ == "__main__":
    main()
