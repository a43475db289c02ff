"""What pages are made of: templates, styles and scripts of the package."""

import base64
from importlib.resources import files

import jinja2
from markupsafe import Markup


def load_template(name: str, package: str = "sigmaslam.report") -> jinja2.Template:
    """A template of a package; it escapes what it is given."""
    return jinja2.Environment(
        loader=jinja2.PackageLoader(package, "templates"),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    ).get_template(name)


def read_asset(name: str) -> Markup:
    """A style or a script, which a page holds as it is."""
    return Markup((files("sigmaslam.report") / "assets" / name).read_text(encoding="utf-8"))


def data_url(jpeg: bytes) -> str:
    """A JPEG file as a page holds it."""
    return "data:image/jpeg;base64," + base64.b64encode(jpeg).decode()
