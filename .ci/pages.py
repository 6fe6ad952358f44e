"""Pages of the site: READMEs where they lie in the repository, so that links hold, and docstrings by package."""

from pathlib import Path

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files

ROOT = Path(__file__).parents[1]
TEXTS = ("README.md", "mjxgrad/*.md", "experiments/*.md", "experiments/gallery/*")


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add what the navigation names to the files of the site."""
    for path in (found for pattern in TEXTS for found in ROOT.glob(pattern)):
        files.append(File.generated(config, path.relative_to(ROOT).as_posix(), abs_src_path=str(path)))
    for page in config.nav[-1]["Reference"]:
        (source,) = page.values()
        package = source.removeprefix("api/").removesuffix(".md")
        files.append(File.generated(config, source, content=f"# {package}\n\n::: {package}\n"))
    return files
