"""What the site has beside docs/: README as its first page, pages that links lead to, and a reference of the packages.

Pages are written for the repository: a link is relative to the file that it stands in. On the site README.md becomes
index.md, what lies in docs/ moves up by a folder, and other files that a page links to are taken along. mkdocs calls
`on_files` and `on_page_markdown`.
"""

import re
from pathlib import Path
from posixpath import dirname, relpath

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

ROOT = Path(__file__).resolve().parents[1]
LINK = re.compile(r"(?<=\]\()([^)\s#]+)")
# Packages that have a page of reference each.
PACKAGES = (
    "sigmaslam",
    "sigmaslam_filters",
    "sigmaslam_filters.consistency",
    "sigmaslam_localisation",
    "sigmaslam_models",
    "sigmaslam_synthetic",
)


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Adds README, what the pages link to outside docs/, and the reference."""
    pending = [ROOT / "README.md", *(Path(file.abs_src_path) for file in files.documentation_pages())]
    while pending:
        path = pending.pop()
        place = site_path(path)
        if files.get_file_from_path(place) is None:
            files.append(File.generated(config, place, abs_src_path=str(path)))
        if path.suffix == ".md":
            linked = {(path.parent / target).resolve() for target in LINK.findall(path.read_text(encoding="utf-8"))}
            pending += [each for each in linked if each.is_file() and not files.get_file_from_path(site_path(each))]
    for name in PACKAGES:
        # A package without public names of its own shows its modules; `sigmaslam` would show the whole tree.
        module = f"{name.replace('.', '/')}/__init__.py"
        init = next(ROOT.glob(f"*/{module}"), ROOT / module).read_text(encoding="utf-8")
        members = "" if "__all__" not in init else "\n    options:\n      show_submodules: false"
        files.append(File.generated(config, f"reference/{name}.md", content=f"# {name}\n\n::: {name}{members}\n"))
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Turns links between files of the repository into links between pages of the site."""
    if page.file.abs_src_path is None:
        return markdown
    folder = Path(page.file.abs_src_path).parent

    def moved(match: re.Match[str]) -> str:
        path = (folder / match[0]).resolve()
        return relpath(site_path(path), dirname(page.file.src_uri) or ".") if path.is_file() else match[0]

    return LINK.sub(moved, markdown)


def site_path(path: Path) -> str:
    """Place of a file of the repository among the pages of the site."""
    place = path.relative_to(ROOT)
    if place == Path("README.md"):
        return "index.md"
    return (place.relative_to("docs") if place.is_relative_to("docs") else place).as_posix()
