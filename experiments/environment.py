"""What a result was made with, and whether making it again would give the same."""

import hashlib
import importlib.metadata
import json
import os
import platform
import subprocess
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parent.parent
PACKAGES = ("mjxgrad", "jax", "jaxlib", "mujoco", "mujoco-mjx", "equinox", "numpy", "scipy", "matplotlib", "mediapy")


def versions() -> dict[str, str]:
    """Versions of Python and of the packages that results depend on; "source tree" if not installed."""
    found = {"python": platform.python_version()}
    for package in PACKAGES:
        try:
            found[package] = importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:
            found[package] = "source tree"
    return found


def commit() -> tuple[str | None, bool | None]:
    """The commit of the source, and whether files differ from it; None outside a git repository."""
    try:
        head = _git("rev-parse", "HEAD")
        return head, bool(_git("status", "--porcelain"))
    except (OSError, subprocess.CalledProcessError):
        return None, None


def device() -> dict[str, Any]:
    """What JAX computes on; JAX has been set up by then."""
    import jax

    first = jax.devices()[0]
    return {
        "platform": first.platform,
        "kind": first.device_kind,
        "count": jax.device_count(),
        "processors": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count(),
    }


def fingerprint(settings: Any) -> str:
    """A hash of all that decides a result: settings, source and versions.

    The source is hashed rather than its commit asked for, so that an uncommitted change counts too.
    """
    digest = hashlib.sha256(json.dumps([settings, versions()], sort_keys=True).encode())
    for folder, pattern in (("mjxgrad", "*.py"), ("experiments", "*.py"), ("mjcf", "*")):
        for path in sorted((ROOT / folder).rglob(pattern)):
            if path.is_file():
                digest.update(str(path.relative_to(ROOT)).encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()


def _git(*arguments: str) -> str:
    result = subprocess.run(["git", *arguments], cwd=ROOT, capture_output=True, text=True, check=True)
    return result.stdout.strip()
