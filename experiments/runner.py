"""From a configuration to a finished output folder."""

import hashlib
import importlib.metadata
import json
import platform
import re
import shlex
import subprocess
import sys
import time
import zlib
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

from experiments.config import ExperimentError, Run, load_runs, part
from experiments.output import building, keeping, recover, write_csv, write_toml, write_whole, writing
from experiments.words import joined, merged
from experiments.workspace import CompileClock, Workspace, num_cores

if TYPE_CHECKING:
    from experiments.report import Report

ROOT = Path(__file__).parent.parent
_PACKAGES = ("mjxgrad", "jax", "jaxlib", "mujoco", "mujoco-mjx", "equinox", "numpy", "scipy", "matplotlib", "mediapy")
# What a kind may say of its outcome, each by a function of that name.
_SAID = ("answer", "verdict", "findings", "tables", "summary", "warnings", "headline")


def run_file(file: str, overrides: list[str], *, output: Path, force: bool) -> Path:
    """Run a configuration, every combination if it sweeps.

    A result whose settings, source and versions are unchanged is kept: an interrupted sweep goes on where it stopped.

    Files and overrides are those of `load_runs`, `output` is the folder that holds each run's folder, and the path that of the
    report. An `ExperimentError` says why a run cannot go on.
    """
    runs = load_runs(file, overrides)
    command = shlex.join(["python", "-m", "experiments", "run", file, *overrides])
    is_sweep = bool(runs[0].varied)
    top = output / (f"{runs[0].name}-sweep" if is_sweep else runs[0].name)
    folders = [top / _folder_name(run.varied) if is_sweep else top for run in runs]
    for run, folder in zip(runs, folders, strict=True):
        _run_one(run, folder, command, force)
    if is_sweep:
        from experiments.report import overview

        with writing(top):
            summary = _of_sweep(runs[0], folders)
            write_whole(top / "report.html", overview(runs, folders, summary["answer"]))
            write_whole(top / "summary.json", json.dumps(summary, indent=2) + "\n")
        print(f"sweep of {len(runs)}: {top / 'report.html'}")
    return top / "report.html"


def _run_one(run: Run, folder: Path, command: str, force: bool) -> None:
    recover(folder)
    settings = run.settings.model_dump(mode="json")
    # Of a scene of one's own, what its files say, too.
    own = (Path(str(settings.get(key)).rpartition(":")[0 if key == "cost" else 2]) for key in ("scene", "cost"))
    fingerprint = _fingerprint([settings, run.question, run.expected, [p.read_text() for p in own if p.is_file()]])
    previous = _previous(folder)
    if previous.get("fingerprint") == fingerprint and not force:
        print(f"unchanged: {folder / 'report.html'} (same settings and code; --force runs it again)")
        return
    with building(folder) as partial:
        _set_up_jax(run.settings.precision)
        print(f"{folder}: {run.question}", file=sys.stderr)
        kept = keeping(folder, fingerprint)
        workspace, started, compiling = Workspace(partial, kept), time.perf_counter(), CompileClock()
        report = _call(run, workspace)
        head, is_dirty = _commit()
        facts = {
            "command": command,
            "finished": datetime.now(UTC).isoformat(timespec="seconds"),
            "commit": head,
            "dirty": is_dirty,
            "versions": _versions(),
            "device": _device(),
            "seconds": {
                **workspace.seconds,
                "total": time.perf_counter() - started + workspace.kept_seconds,
                "of it compiling": compiling.seconds,
                **({"of it before an interruption": workspace.kept_seconds} if workspace.kept_seconds else {}),
            },
            "fingerprint": fingerprint,
        }
        with writing(folder):
            _write(run, report, partial, facts)
    print(f"{report.answer}\n{report.verdict}\n{folder / 'report.html'}")
    if report.video is None and report.video_caption:
        print(f"no video: {report.video_caption}", file=sys.stderr)


def write_gallery(output: Path) -> Path:
    """Write the page over all results in a folder of runs; an `ExperimentError` if there are none."""
    from experiments.report import gallery

    found = {path.parent.name: json.loads(path.read_text(encoding="utf-8")) for path in output.glob("*/summary.json")}
    # Results of an earlier version have no question.
    shown = {name: summary for name, summary in sorted(found.items()) if "question" in summary}
    if not shown:
        raise ExperimentError(f"there are no results in {output}: make demo leaves one; --output names another folder")
    with writing(output):
        write_whole(output / "index.html", gallery(shown))
    for name in sorted(set(found) - set(shown)):
        print(f"left out: {output / name}, made by an earlier version; run it again", file=sys.stderr)
    print(output / "index.html")
    return output / "index.html"


def _of_sweep(run: Run, folders: list[Path]) -> dict[str, Any]:
    """Sum up a sweep as one run is, by its first combination's pictures."""
    summaries = [json.loads((folder / "summary.json").read_text(encoding="utf-8")) for folder in folders]
    answers = list(dict.fromkeys(summary["answer"] for summary in summaries))
    together = getattr(part(run.settings.experiment, "report"), "together", lambda _: None)(summaries)
    told = together or (answers[0] if len(answers) == 1 else f"{len(answers)} answers in {len(folders)} runs.")
    pictures = {name: (one := summaries[0][name]) and f"{folders[0].name}/{one}" for name in ("figure", "video")}
    return {"name": run.name, "question": run.question, "answer": told, **pictures}


def _call(run: Run, workspace: Workspace) -> "Report":
    """Run the experiment; what the library warns of, and what it finds unstable, goes into the report, not to the terminal."""
    with workspace.listening():
        # Late, once the precision is chosen: these import JAX and MuJoCo.
        from experiments.report import Report
        from experiments.theme import save

        measure, words, pictures = (part(run.settings.experiment, name) for name in ("measure", "report", "figures"))
        # Before anything is measured.
        needed = {"answer": words, "verdict": words, "tables": words, "drawings": pictures}
        if missing := [name for name, module in needed.items() if not callable(getattr(module, name, None))]:
            raise ExperimentError(
                f"experiment {run.settings.experiment} lacks {joined(missing)}: see experiments/README.md"
            )
        outcome = measure.measure(run.settings, workspace)
        # A kind of one file may have imported a module of such a name.
        said: dict[str, Any] = {name: tell(outcome) for name in _SAID if callable(tell := getattr(words, name, None))}
        wanted = getattr(run.settings, "video", None)
        video, caption = pictures.video(outcome, workspace, wanted) if wanted else (None, "")
        figures = save(pictures.drawings(outcome), workspace.folder)
        report = Report(**said, figures=figures, metrics=outcome.rows(), video=video, video_caption=caption)
    # A scene warns of some of it when it is loaded.
    return replace(report, warnings=merged([*report.warnings, *workspace.told, *workspace.warnings]))


def _write(run: Run, report: "Report", folder: Path, facts: dict[str, Any]) -> None:
    from experiments.report import page

    header = "\n".join(filter(None, [run.question, f"Expected: {run.expected}" if run.expected else ""]))
    write_toml(folder / "config.toml", run.settings.model_dump(mode="json"), header)
    write_csv(folder / "metrics.csv", report.metrics)
    (folder / "environment.json").write_text(json.dumps(facts, indent=2) + "\n", encoding="utf-8")
    name = " · ".join([run.name, *(f"{key} = {value}" for key, value in run.varied.items())])
    summary = {
        "name": name,
        "question": run.question,
        "answer": report.answer,
        "verdict": report.verdict,
        "headline": report.headline,
        "figure": report.figures[0].file if report.figures else None,
        "video": report.video,
    }
    write_whole(folder / "summary.json", json.dumps(summary, indent=2) + "\n")
    told = {"question": run.question, "expected": run.expected, "about": _about(facts)}
    text = page(report, folder, name=name, config=(folder / "config.toml").read_text(encoding="utf-8"), **told)
    (folder / "report.html").write_text(text, encoding="utf-8")


def _about(facts: dict[str, Any]) -> dict[str, dict[str, Any]]:
    commit = (facts["commit"] or "no repository")[:12] + (" with uncommitted changes" if facts["dirty"] else "")
    device = facts["device"]
    return {
        "Time": {name: f"{seconds:.1f} s" for name, seconds in facts["seconds"].items()},
        "Made with": {
            "command": facts["command"],
            "commit": commit,
            "finished": facts["finished"],
            "device": f"{device['count']} × {device['kind']} ({device['platform']}), {device['processors']} processors",
            **facts["versions"],
        },
    }


def _previous(folder: Path) -> dict[str, Any]:
    """What the folder's result was made with; nothing if there is none or it is damaged."""
    try:
        facts = json.loads((folder / "environment.json").read_text(encoding="utf-8"))
        has_report = (folder / "report.html").stat().st_size > 0
        return facts if has_report and isinstance(facts, dict) else {}
    except (OSError, ValueError, RecursionError):
        return {}


def _set_up_jax(precision: str) -> None:
    library = importlib.import_module("mjxgrad")  # first, since it tells of a wrong environment in a sentence
    importlib.import_module("jax").config.update("jax_enable_x64", precision == "float64")
    library.keep_compiled()


def _folder_name(varied: dict[str, Any]) -> str:
    """Name a combination: readable, fit for any file system, different for different values."""
    text = ",".join(f"{key}={value}" for key, value in varied.items())
    safe = re.sub(r"[^\w.,=+-]", "_", text)[:100]
    return safe if safe == text else f"{safe}-{zlib.crc32(text.encode()):08x}"


def _versions() -> dict[str, str]:
    """Versions of Python and of the packages that results depend on; "source tree" if not installed."""
    found = {"python": platform.python_version()}
    for package in _PACKAGES:
        try:
            found[package] = importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:
            found[package] = "source tree"
    return found


def _commit() -> tuple[str | None, bool | None]:
    """The commit of the source, and whether files differ from it; None outside a git repository."""
    try:
        head = _git("rev-parse", "HEAD")
        return head, bool(_git("status", "--porcelain"))
    except (OSError, subprocess.CalledProcessError):
        return None, None


def _device() -> dict[str, Any]:
    """What JAX computes on; JAX has been set up by then."""
    import jax

    first = jax.devices()[0]
    return {
        "platform": first.platform,
        "kind": first.device_kind,
        "count": jax.device_count(),
        "processors": num_cores(),
    }


def _fingerprint(settings: Any) -> str:
    """A hash of all that decides a result: settings, source and versions.

    The source is hashed rather than its commit asked for, so that an uncommitted change counts too.
    """
    digest = hashlib.sha256(json.dumps([settings, _versions()], sort_keys=True).encode())
    for folder, pattern in (("mjxgrad", "*.py"), ("experiments", "*.py"), ("mjcf", "*")):
        for path in sorted((ROOT / folder).rglob(pattern)):
            if path.is_file():
                digest.update(str(path.relative_to(ROOT)).encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()


def _git(*arguments: str) -> str:
    result = subprocess.run(["git", *arguments], cwd=ROOT, capture_output=True, text=True, check=True)
    return result.stdout.strip()
