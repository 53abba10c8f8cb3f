"""What all tests share: where more data may be, where temporary files are, and that CI skips nothing."""

import gc
import os
import shutil
import signal
import tempfile
from pathlib import Path

import pytest
from hypothesis import settings
from xdist.scheduler import LoadScopeScheduling

from tests.support import once
from tests.tools import apart

# Busy machines are slow; what must be fast is timed elsewhere, as whole processes.
settings.register_profile("steady", deadline=None)
settings.load_profile("steady")

# As fogspec itself does where it starts: to look for garbage every 700 objects is a tenth of the time here.
gc.set_threshold(200_000)

# Several workers share the CPUs. Threads of one more library would wait for each other, busily, and sums would depend on their
# number. It is read when numpy is imported, after this.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

# A shell without job control starts what it puts in the background (`make test &`) with Ctrl-C ignored, which every
# process below would inherit: those that are to end by it would not, and bash could not even trap it.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

# SkyPilot's API server outlives the test that starts it, with the user's own state, and holds a port that the next one wants.
# Only tests beside a cluster or an account of their own start one; no other test meets one that runs here.
if apart.FOLDER not in os.environ:
    os.environ |= {"SKYPILOT_DISABLE_LOCAL_API_SERVER": "1", "SKYPILOT_API_SERVER_LOCAL_PORT": "1"}

ROOT = Path(__file__).resolve().parent.parent
PUBLIC_SUITE = ROOT / "tests" / "data" / "suite"

# Data that may not enter this repository. Tests run on what is in it, and on these too where they are.
SHARED = Path(os.environ.get("FOGSPEC_SHARED", ROOT.parent / "shared"))

TEMPORARY_BYTES = 800 << 20  # 600 MiB were seen at the end of a whole run

# What has one cluster, browser or laid-out project for all its tests runs in one worker.
TOGETHER = ("tests/aws/", "tests/slurm/", "tests/browser/", "tests/contract/")


def pytest_configure(config: pytest.Config) -> None:
    """Everything temporary is below one folder, which ends with the session, whatever was killed in it."""
    if apart.FOLDER in os.environ or "PYTEST_XDIST_WORKER" in os.environ:
        return  # workers have the folder of the process that starts them
    free = shutil.disk_usage(tempfile.gettempdir()).free
    if free < TEMPORARY_BYTES:
        needs = f"tests write about {TEMPORARY_BYTES >> 20:,} MiB of temporary files, and {tempfile.gettempdir()} has"
        pytest.exit(f"{needs} {free >> 20:,} MiB free: set TMPDIR to a folder with more", 4)
    os.environ.setdefault("PYTEST_DEBUG_TEMPROOT", tempfile.gettempdir())  # where pytest keeps what failed tests wrote
    folder = tempfile.mkdtemp(prefix="fog-")
    os.chmod(folder, 0o711)  # another user may reach what a test opens to others
    config.add_cleanup(lambda: shutil.rmtree(folder, ignore_errors=True))
    os.environ |= {"TMPDIR": folder, once.SESSION: folder}
    tempfile.tempdir = folder
    if not os.access(os.path.expanduser("~"), os.W_OK):  # SkyPilot cannot be imported without one to write to
        os.environ["HOME"] = tempfile.mkdtemp(prefix="home-")


def pytest_collection_finish(session: pytest.Session) -> None:
    """Thousands of tests and all that they import stay: no look for garbage goes through them, or copies them in a fork."""
    gc.collect()
    gc.freeze()


class Together(LoadScopeScheduling):
    """Tests go to whichever worker is free, those of one place in `TOGETHER` to one."""

    def _split_scope(self, nodeid: str) -> str:
        return next((place for place in TOGETHER if nodeid.startswith(place)), nodeid)


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: object) -> Together:
    """xdist's own groups need a pytest older than 9."""
    return Together(config, log)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item: pytest.Item, call: pytest.CallInfo[None]):
    """With CI=true a skipped test is a failure: whatever it needs must have been installed."""
    report = yield
    if os.environ.get("CI") == "true" and report.skipped and not hasattr(report, "wasxfail"):
        reason = report.longrepr[2] if isinstance(report.longrepr, tuple) else report.longrepr
        if "FOGSPEC_SHARED" in str(reason):  # data that may not be published, which a public CI cannot have
            return report
        report.outcome = "failed"
        report.longrepr = f"skipped in CI, where nothing may be: {reason}"
    return report
