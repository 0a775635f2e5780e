"""What all tests share: the Hypothesis profile and the folder of evidence."""

import gc
import os
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import settings

ROOT = Path(__file__).resolve().parent.parent

# Most of what is made stays, so that to look for garbage as often as usual finds little.
gc.set_threshold(2_000_000, 50, 100)

# No deadline: a first call may compile texts. In CI a failure must come back on the next run.
settings.register_profile(
    "ecatspec",
    deadline=None,
    print_blob=True,
    derandomize=bool(os.environ.get("CI")),
)
settings.load_profile("ecatspec")


def pytest_sessionfinish() -> None:
    """Look for garbage until there is none; pytest looks five times through all that is kept."""
    while gc.collect():
        pass
    gc.freeze()


@pytest.fixture(autouse=True, scope="session")
def state_folder(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """Where runs leave their records: not in the home of whoever tests."""
    folder = tmp_path_factory.mktemp("state")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_STATE_HOME", str(folder))
        yield folder


@pytest.fixture(scope="session")
def shared() -> Path:
    """The folder of manuals, captures and evidence, which is not part of the repository."""
    named = os.environ.get("ECATSPEC_SHARED")
    folder = Path(named) if named else ROOT.parent / "shared"
    if not folder.is_dir():
        pytest.skip(f"no folder {folder}; ECATSPEC_SHARED names another one")
    return folder
