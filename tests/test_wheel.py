"""What pip installs works without the checkout."""

import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]


@pytest.mark.slow
def test_a_wheel_holds_every_file_that_the_library_reads(tmp_path):
    subprocess.run([sys.executable, "-m", "pip", "wheel", "-q", "--no-deps", "-w", tmp_path, ROOT], check=True)
    with zipfile.ZipFile(next(tmp_path.glob("*.whl"))) as wheel:
        wheel.extractall(tmp_path)
    ours = [*ROOT.glob("mjxgrad/**/*.*"), *ROOT.glob("mjcf/*")]
    places = [path.relative_to(ROOT / "mjxgrad" if path.is_relative_to(ROOT / "mjxgrad") else ROOT) for path in ours]
    missing = [place for place in places if place.suffix != ".pyc" and not (tmp_path / "mjxgrad" / place).exists()]
    assert not missing
    code = "import mjxgrad as mg, mjxgrad.report as r; mg.tasks.ball_wall(); r.page('t', 'h', []); print(mg.__file__)"
    ran = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=True)
    assert ran.stdout.startswith(str(tmp_path))
