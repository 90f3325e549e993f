"""What ``python -m build`` makes, installed in a fresh environment and used away from the
repository.
"""

from __future__ import annotations

import os
import re
import runpy
import shutil
import subprocess
import sys
import tarfile
import zipfile
from email.parser import Parser
from pathlib import Path

import pytest

from mitsuba_irrcache import __version__

ROOT = Path(__file__).parents[2]
PYTHONS = [f"3.{minor}" for minor in range(10, 14)]
#: What pip says when it cannot reach an index.
UNREACHABLE = re.compile(
    r"No matching distribution|Failed to establish|Temporary failure|Could not fetch", re.IGNORECASE
)
#: As README.md begins, with a small image; "-I" keeps the repository off the path.
USE = """
import mitsuba as mi
import numpy as np
import mitsuba_irrcache
from mitsuba_irrcache.scenes import scene_path
mi.set_variant("llvm_ad_rgb")
scene = mi.load_file(scene_path("cloud"), size=16)
image = mi.TensorXf(mi.render(scene, spp=4))
assert image.shape == (16, 16, 3) and 0.1 < float(mi.Float(image.array)[384]) < 10, image
named = mi.load_string(
    '<scene version="3.0.0"><integrator type="irrcache"><integer name="max_depth" value="2"/>'
    "</integrator></scene>"
)
assert type(named.integrator()).__name__ == "IrradianceCachingIntegrator"
try:
    mi.load_dict({"type": "irrcache", "max_dept": 2})
except RuntimeError as error:
    assert 'did you mean "max_depth"' in str(error), error
else:
    raise AssertionError("a misspelt property was accepted")
np.save("density.npy", np.linspace(0, 1, 120, dtype=np.float32).reshape(4, 5, 6))
print(scene_path("cloud"))
print(mitsuba_irrcache.__file__)
"""


def run(*command: object, **options) -> subprocess.CompletedProcess:
    """Run a command away from the repository's settings; the caller judges its status."""
    environment = {k: v for k, v in os.environ.items() if not k.startswith("PYTHON")}
    return subprocess.run(
        [str(part) for part in command], capture_output=True, text=True, env=environment, **options
    )


def installed(*command: object) -> None:
    """Run pip or build; skip the test if the packages that it needs cannot be reached."""
    done = run(*command)
    if done.returncode and UNREACHABLE.search(done.stdout + done.stderr):
        pytest.skip(f"packages cannot be installed here: {done.stderr.strip().splitlines()[-1]}")
    assert done.returncode == 0, done.stdout + done.stderr


def python(version: str) -> str:
    """Return an interpreter of this version on the path or of pyenv; skip the test without one."""
    kept = Path(os.environ.get("PYENV_ROOT", Path.home() / ".pyenv")) / "versions"
    found = [shutil.which(f"python{version}"), *sorted(kept.glob(f"{version}.*/bin/python"))]
    for candidate in filter(None, found):
        said = run(candidate, "-c", "import sys, venv; print(*sys.version_info[:2], sep='.')")
        if said.stdout.strip() == version:
            return str(candidate)
    pytest.skip(f"there is no Python {version}")


@pytest.fixture(scope="module")
def distributions(tmp_path_factory) -> dict[str, Path]:
    """The sdist and the wheel that is built from it."""
    folder = tmp_path_factory.mktemp("dist")
    installed(sys.executable, "-m", "build", "--outdir", folder, ROOT)
    (sdist,), (wheel,) = folder.glob("*.tar.gz"), folder.glob("*.whl")
    return {"sdist": sdist, "wheel": wheel}


@pytest.mark.slow
@pytest.mark.parametrize("version", PYTHONS)
def test_the_wheel_does_what_the_readme_says(distributions, version, tmp_path):
    interpreter, environment = python(version), tmp_path / "environment"
    installed(interpreter, "-m", "venv", environment)
    bin_ = environment / "bin"
    pip = (bin_ / "python", "-m", "pip", "--disable-pip-version-check", "install", "--quiet")
    installed(*pip, distributions["wheel"])

    done = run(bin_ / "python", "-I", "-c", USE, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    scene, package = done.stdout.splitlines()
    assert package.startswith(str(environment))

    def irrcache(*arguments: object) -> subprocess.CompletedProcess:
        return run(bin_ / "irrcache", *arguments, cwd=tmp_path)

    small = ("-o", "out.exr", "-D", "size=16", "--spp", "4")
    assert irrcache("--version").stdout == f"irrcache {__version__}\n"
    done = irrcache("render", scene, *small)
    assert done.returncode == 0 and (tmp_path / "out.png").stat().st_size > 100, done.stderr

    # Formats that need no extra, and the integrator by its name in a scene.
    done = irrcache("import", "density.npy", "--density", "3", "-o", "plain")
    assert done.returncode == 0, done.stderr
    sizes = ("-D", "width=16", "-D", "height=16", "-D", "integrator=irrcache")
    done = irrcache("render", "plain/scene.xml", *sizes, "--spp", "4")
    assert done.returncode == 0, done.stderr
    done = irrcache("doctor")
    assert "[volumes]" in done.stdout and "Traceback" not in done.stdout + done.stderr

    # Commands and formats whose packages are extras say which one, and how to install it.
    for suffix in ("nii.gz", "tif", "nc", "nvdb"):
        (tmp_path / f"volume.{suffix}").write_bytes(b"0")
    imported = ("--density", "-o", "other")
    for extra, command in (
        ("volumes", ("import", "volume.nii.gz", *imported)),
        ("microscopy", ("import", "volume.tif", *imported)),
        ("science", ("import", "volume.nc", *imported)),
        ("nanovdb", ("import", "volume.nvdb", *imported)),
        ("compare", ("compare", scene, "-i", "irrcache", "-o", "report")),
        ("view", ("view", scene)),
        ("farm", ("farm", "frames", scene, "--vary", "size=8:16:2", "-o", "frames")),
    ):
        done = irrcache(*command)
        assert done.returncode == 1, done.stdout
        assert f'-m pip install "mitsuba_irrcache[{extra}]"' in done.stderr
        assert "Traceback" not in done.stderr

    installed(*pip, f"{distributions['wheel']}[volumes]")
    done = irrcache("import", "phantom:cloud:32,32,32", "--density", "20", "-o", "cloud")
    assert done.returncode == 0, done.stderr
    done = irrcache("render", "cloud/scene.xml", "-D", "width=16", "-D", "height=16", "--spp", "4")
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "cloud/scene.png").stat().st_size > 100


@pytest.mark.slow
def test_the_sdist_has_what_building_and_testing_need(distributions):
    with tarfile.open(distributions["sdist"]) as archive:
        names = {name.partition("/")[2] for name in archive.getnames()}
    tracked = subprocess.run(
        ["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, check=True
    ).stdout.splitlines()
    assert {n for n in tracked if not n.startswith(".")} <= names
    assert not [n for n in names if "__pycache__" in n or "/output/" in n]


@pytest.mark.slow
def test_the_wheel_has_every_module_and_no_dead_link(distributions):
    with zipfile.ZipFile(distributions["wheel"]) as archive:
        names = set(archive.namelist())
        (path,) = (n for n in names if n.endswith(".dist-info/METADATA"))
        metadata = Parser().parsestr(archive.read(path).decode())
    modules = {f"{p.relative_to(ROOT)}" for p in (ROOT / "mitsuba_irrcache").rglob("*.py")}
    tops = {
        f"mitsuba_irrcache/{p.relative_to(ROOT)}"
        for folder in ("integrators", "scenes")
        for p in (ROOT / folder).glob("*.*")
    }
    assert modules | tops <= names
    assert metadata["Version"] == __version__
    assert metadata["Description-Content-Type"] == "text/markdown"
    description = metadata.get_payload()
    assert description.startswith("# mitsuba_irrcache")
    assert not re.findall(r"\]\((?!https?:|#)", description)


def test_links_of_the_description_lead_out_of_the_repository():
    describe = runpy.run_path(str(ROOT / "setup.py"))["description"]
    text = "A\n\n![cover](docs/a.jpg)\n\n*Caption.*\n\nB [all](docs/b.md#c) [far](https://x.org/)\n"
    assert describe(text, "") == "A\n\nB all [far](https://x.org/)\n"
    assert describe(text, "https://example.org/r/") == (
        "A\n\n![cover](https://example.org/r/raw/main/docs/a.jpg)\n\n*Caption.*\n\n"
        "B [all](https://example.org/r/blob/main/docs/b.md#c) [far](https://x.org/)\n"
    )


def test_there_is_one_version():
    cited = re.search(r"^version: (.+)$", (ROOT / "CITATION.cff").read_text(), re.MULTILINE)[1]
    assert cited == __version__
    assert 'dynamic = ["version"' in (ROOT / "pyproject.toml").read_text()
    assert f"## [{__version__}]" in (ROOT / "CHANGELOG.md").read_text()
