"""Finding an OpenGL that renders without a display."""

import os
import subprocess
import sys
import tempfile

CANDIDATES = ("egl", "osmesa", "glfw")

# MuJoCo chooses its OpenGL once, while it is imported, and a broken driver may end the process: so others try.
PROBE = """
import mujoco
model = mujoco.MjModel.from_xml_string("<mujoco><worldbody><geom size='.1'/></worldbody></mujoco>")
data = mujoco.MjData(model)
mujoco.mj_forward(model, data)
with mujoco.Renderer(model, 8, 8) as renderer:
    renderer.update_scene(data)
    renderer.render()
print("rendered")
"""


class OpenGL:
    """A search for an offscreen OpenGL, under way in other processes while this one imports JAX."""

    def __init__(self):
        asked_for = os.environ.get("MUJOCO_GL", "").strip()
        # MuJoCo writes MUJOCO_LOG.TXT into the current folder when a candidate fails.
        self._folder = tempfile.TemporaryDirectory(ignore_cleanup_errors=True)
        self._probes = {name: _start(name, self._folder.name) for name in ([asked_for] if asked_for else CANDIDATES)}

    def settle(self) -> str | None:
        """Wait for the search and set MUJOCO_GL by it, before MuJoCo is imported.

        Returns:
            The first candidate that renders, or None; rendering is then switched off.
        """
        found = None
        for name, process in self._probes.items():
            output = _finish(process)
            if found is None and "rendered" in output:
                found = name
        self._folder.cleanup()
        os.environ["MUJOCO_GL"] = found or "disable"
        return found


def _start(name: str, folder: str) -> subprocess.Popen:
    return subprocess.Popen(
        [sys.executable, "-c", PROBE],
        env={**os.environ, "MUJOCO_GL": name},
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        cwd=folder,
        text=True,
    )


def _finish(process: subprocess.Popen) -> str:
    try:
        return process.communicate(timeout=30)[0]
    except subprocess.TimeoutExpired:
        process.kill()
        return process.communicate()[0]
