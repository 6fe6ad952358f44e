"""Where the scenes of the tasks are."""

from pathlib import Path

# Beside the package in a checkout, inside it when installed from a wheel.
_FOLDERS = (Path(__file__).parents[2] / "mjcf", Path(__file__).parents[1] / "mjcf")


def scene_path(name: str) -> Path:
    """Find the MJCF file of a task.

    Args:
        name: the task's.

    Returns:
        The path of its scene.

    Raises:
        FileNotFoundError: if there is no such file; the message says where it was looked for.
    """
    for folder in _FOLDERS:
        path = folder / f"{name}.xml"
        if path.is_file():
            return path
    looked = " nor ".join(str(folder) for folder in _FOLDERS)
    raise FileNotFoundError(f"no scene {name}.xml in {looked}: run from a checkout, or install the wheel again")
