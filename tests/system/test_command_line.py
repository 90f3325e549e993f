"""The commands from end to end, and invalid input: a clear error, and no files written."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys

import mitsuba as mi
import numpy as np
import OpenImageIO
import pytest

from mitsuba_irrcache.cache.volume import IrradianceCache
from mitsuba_irrcache.cli.main import main
from tests.support.scene_xml import FOG_IN_A_BOX

SCENE = """<scene version="3.0.0">
    <default name="density" value="density.vol"/>
    <default name="integrator" value="volpath"/>
    <integrator type="$integrator"> <integer name="max_depth" value="2"/> </integrator>
    <sensor type="perspective" id="front">
        <transform name="to_world">
            <lookat origin="0, 0, -5" target="0, 0, 0" up="0, 1, 0"/>
        </transform>
        <film type="hdrfilm">
            <integer name="width" value="12"/> <integer name="height" value="8"/>
        </film>
        <sampler type="independent"> <integer name="sample_count" value="4"/> </sampler>
    </sensor>
    <sensor type="perspective" id="side">
        <transform name="to_world">
            <lookat origin="5, 0, 0" target="0, 0, 0" up="0, 1, 0"/>
        </transform>
        <film type="hdrfilm">
            <integer name="width" value="6"/> <integer name="height" value="6"/>
        </film>
    </sensor>
    FOG
    <emitter type="constant"/>
    EXTRA
</scene>
""".replace("FOG", FOG_IN_A_BOX)


@pytest.fixture(autouse=True)
def _variant(rgb):
    """Restore the variant, which a command sets for the whole process."""
    yield
    mi.set_variant("llvm_ad_rgb")


@pytest.fixture
def folder(tmp_path, scenes):
    mi.VolumeGrid(scenes.texture((4, 5, 6, 1), 0, 2, 1)).write(str(tmp_path / "density.vol"))
    (tmp_path / "scene.xml").write_text(SCENE.replace("EXTRA", ""))
    return tmp_path


def run(*arguments) -> int:
    return main([str(a) for a in arguments])


def read(path) -> np.ndarray:
    return np.array(OpenImageIO.ImageBuf(str(path)).get_pixels(OpenImageIO.FLOAT))


# Images


def test_render_several_media(folder):
    """Their caches are in no header, since there is no single one; the image is written."""
    other = """<shape type="sphere"> <point name="center" x="4" y="0" z="0"/> <bsdf type="null"/>
        <medium name="interior" type="homogeneous" id="ball"> <float name="albedo" value="0.5"/>
        </medium> </shape>"""
    (folder / "two.xml").write_text(SCENE.replace("EXTRA", other))
    flags = ["--spp", 1, "-i", "irrcache{solver=path,resolution=4,cache_spp=8}"]
    assert run("render", folder / "two.xml", "-o", folder / "out.exr", *flags) == 0
    header = OpenImageIO.ImageInput.open(str(folder / "out.exr")).spec()
    assert header.getattribute("irrcache:cache") is None
    assert "resolution = 4" in header.getattribute("irrcache:integrator")


def test_render(folder, capsys):
    """``render`` writes an EXR with its settings in the header and a PNG, and prints the times."""
    assert run("render", folder / "scene.xml", "-o", folder / "out.exr", "--spp", 16) == 0
    printed = capsys.readouterr().out
    assert "out.exr" in printed and "out.png" in printed and "cache" in printed
    image = read(folder / "out.exr")
    assert image.shape[:2] == (8, 12) and np.isfinite(image).all() and image[..., :3].mean() > 0.1
    header = OpenImageIO.ImageInput.open(str(folder / "out.exr")).spec()
    text = str(header.serialize("xml")) if hasattr(header, "serialize") else str(header)
    for part in (
        "irrcache:version",
        "irrcache:spp",
        "irrcache:integrator",
        "irrcache:seconds_cache",
    ):
        assert part in text
    assert "max_depth = 2" in header.getattribute("irrcache:integrator")
    assert set(os.listdir(folder)) == {"scene.xml", "density.vol", "out.exr", "out.png"}


def test_process_ends_with_complete_output(folder):
    """The process exits at once with image, status and both outputs, and reports no leaks."""

    def process(scene: str) -> subprocess.CompletedProcess:
        arguments = ["render", scene, "--spp", "2", "-o", "x.exr"]
        command = [sys.executable, "-m", "mitsuba_irrcache", *arguments]
        return subprocess.run(command, cwd=folder, capture_output=True, text=True)

    done = process("scene.xml")
    assert done.returncode == 0 and "wrote x.exr" in done.stdout
    assert "leaked" not in done.stderr
    assert OpenImageIO.ImageBuf(str(folder / "x.exr")).spec().width == 12
    failed = process("other.xml")
    assert failed.returncode == 1 and "there is no scene file" in failed.stderr


def test_image_equals_mi_render(folder):
    assert run("render", folder / "scene.xml", "-o", folder / "a.exr", "--spp", 8, "--seed", 3) == 0
    scene = mi.load_file(str(folder / "scene.xml"), integrator="irrcache")
    expected = np.array(mi.render(scene, spp=8, seed=3))
    np.testing.assert_allclose(
        read(folder / "a.exr")[..., :3], expected[..., :3], rtol=1e-5, atol=1e-6
    )


def test_flags(folder):
    """Sensor, variant, integrator and parameter can be chosen by options."""
    mi.VolumeGrid(np.zeros((2, 2, 2, 1), np.float32)).write(str(folder / "empty.vol"))
    flags = ["-s", 1, "-m", "llvm_ad_mono", "-i", "irrcache{max_depth=1,hide_emitters=true}"]
    assert (
        run(
            "render",
            folder / "scene.xml",
            "-o",
            folder / "a.exr",
            "-D",
            "density=empty.vol",
            *flags,
        )
        == 0
    )
    image = read(folder / "a.exr")
    assert image.shape[:2] == (6, 6)
    assert not image[..., 0].any()


def test_a_stock_integrator_when_asked(folder):
    assert run("render", folder / "scene.xml", "-o", folder / "a.exr", "-i", "volpath") == 0
    assert read(folder / "a.exr").any()


def test_integrators_that_are_not_replaced_are_named(folder, capsys):
    """A path tracer within another integrator remains, and a message says so."""
    nested = '<integrator type="moment"> <integrator type="volpath"/> </integrator>'
    text = (folder / "scene.xml").read_text()
    start, end = text.index("<integrator"), text.index("</integrator>") + len("</integrator>")
    (folder / "nested.xml").write_text(text[:start] + nested + text[end:])
    assert run("render", folder / "nested.xml", "-o", folder / "a.exr") == 0
    assert 'own integrator "moment" renders the image; -i irrcache' in capsys.readouterr().err
    assert run("render", folder / "scene.xml", "-o", folder / "a.exr") == 0
    assert "own integrator" not in capsys.readouterr().err


BAD_CALLS = {
    "missing scene": (["absent.xml"], r"absent\.xml"),
    "not XML": (["density.vol"], r"density\.vol"),
    "output folder": (["scene.xml", "-o", "nowhere/a.exr"], "nowhere.*does not exist"),
    "output format": (["scene.xml", "-o", "a.jpg"], r"a\.jpg.*\.exr"),
    "sensor": (["scene.xml", "-s", "2"], r"--sensor is 2.*2 sensor"),
    "background without alpha": (["scene.xml", "--background", "white"], r"film with alpha.*rgba"),
    "samples": (["scene.xml", "--spp", "-3"], "--spp is -3"),
    "definition": (["scene.xml", "-D", "density"], "-D .density"),
    "missing volume": (["scene.xml", "-D", "density=gone.vol"], r"gone\.vol"),
    "unknown parameter": (["scene.xml", "-D", "wrong=1"], "wrong"),
    "integrator": (["scene.xml", "-i", "irrcache{step"], "cannot read the integrator"),
    "unknown integrator": (["scene.xml", "-i", "irrcash"], "irrcash"),
    "unknown property": (["scene.xml", "-i", "irrcache{stepp=1}"], "stepp"),
    "unknown quadrature": (["scene.xml", "-i", "irrcache{quadrature=simpson}"], "simpson.*riemann"),
    "unknown solver": (["scene.xml", "-i", "irrcache{solver=fast}"], "fast.*auto"),
    "unknown filter": (["scene.xml", "-i", "irrcache{filter=blur}"], "blur.*none"),
    "negative resolution": (["scene.xml", "-i", "irrcache{resolution=-1}"], "resolution is -1"),
    "huge resolution": (["scene.xml", "-i", "irrcache{resolution=20000}"], "GiB.*lower resolution"),
    "resolution of text": (["scene.xml", "-i", "irrcache{resolution=high}"], "resolution.*high"),
    "max_depth": (["scene.xml", "-i", "irrcache{max_depth=-2}"], "max_depth is -2"),
    "rr_depth": (["scene.xml", "-i", "irrcache{rr_depth=0}"], "rr_depth is 0"),
    "cache_spp": (["scene.xml", "-i", "irrcache{cache_spp=-8}"], "cache_spp is -8"),
    "step": (["scene.xml", "-i", "irrcache{step=0}"], "step is 0"),
    "step NaN": (["scene.xml", "-i", "irrcache{step=nan}"], "step is nan"),
    "budget": (["scene.xml", "--budget", "-1"], "--budget is -1.*seconds above 0"),
    "endless budget": (["scene.xml", "--budget", "inf"], "--budget is inf.*seconds"),
    "error": (["scene.xml", "--error", "nan"], r"--error is nan.*0\.02"),
    "budget without a cache": (
        ["scene.xml", "--budget", "1", "-i", "volpath"],
        '"volpath".*irrcache',
    ),
    "cache folder": (["scene.xml", "-i", "irrcache{cache_file=nowhere/c}"], "cache_file.*nowhere"),
}  # fmt: skip


@pytest.mark.parametrize(("arguments", "message"), BAD_CALLS.values(), ids=BAD_CALLS)
def test_invalid_calls(folder, capsys, monkeypatch, arguments, message):
    """Invalid calls exit with status 1 and one line that names the fault; no traceback, no file."""
    monkeypatch.chdir(folder)
    before = set(os.listdir(folder))
    assert run("render", *arguments) == 1
    error = capsys.readouterr().err
    assert error.startswith("irrcache: error: ") and "Traceback" not in error
    assert _matches(message, error), error
    assert set(os.listdir(folder)) == before


def _matches(pattern: str, text: str) -> bool:
    return re.search(pattern, text, re.DOTALL) is not None


NULL = '<bsdf type="null"/>'
EXTRAS = {
    "medium without bounds": (
        f'<shape type="sphere" id="hole"> {NULL} <medium name="exterior" type="homogeneous" '
        'id="haze"/> </shape>',
        "haze.*infinite",
    ),
    "open boundary": (
        f'<shape type="rectangle" id="pane"> {NULL} <medium name="interior" type="homogeneous"/>'
        "</shape>",
        "pane.*not closed",
    ),
    "inward boundary": (
        f'<shape type="sphere" id="hole"> {NULL} <boolean name="flip_normals" value="true"/>'
        '<medium name="interior" type="homogeneous"/> </shape>',
        "normals.*hole.*inwards",
    ),
    "instance of a medium": (
        f'<shape type="shapegroup" id="group"> <shape type="sphere"> {NULL} '
        '<medium name="interior" type="homogeneous"/> </shape> </shape>'
        '<shape type="instance" id="copy"> <ref id="group"/> </shape>',
        "copy.*instance",
    ),
    "phase function": (
        f'<shape type="sphere" id="other"> <point name="center" value="9, 0, 0"/> {NULL} '
        '<medium name="interior" type="homogeneous" id="haze"> <phase type="hg"> '
        '<float name="g" value="0.95"/> </phase> </medium> </shape>',
        "haze.*HGPhaseFunction",
    ),
}


@pytest.mark.parametrize(("extra", "message"), EXTRAS.values(), ids=EXTRAS)
def test_unsupported_scenes(folder, capsys, extra, message):
    """Unsupported scenes raise an error that names the object and suggests volpath."""
    (folder / "odd.xml").write_text(SCENE.replace("EXTRA", extra))
    before = set(os.listdir(folder))
    assert run("render", folder / "odd.xml") == 1
    error = capsys.readouterr().err
    assert _matches(f"(?i){message}", error) and "volpath" in error, error
    assert set(os.listdir(folder)) == before


@pytest.mark.parametrize("value", [np.nan, -1.0])
def test_bad_voxels(folder, capsys, value):
    voxels = np.ones((2, 3, 4, 1), np.float32)
    voxels[1, 2, 3] = value
    mi.VolumeGrid(voxels).write(str(folder / "bad.vol"))
    assert run("render", folder / "scene.xml", "-D", "density=bad.vol") == 1
    error = capsys.readouterr().err
    assert "sigma_t" in error and "(1, 2, 3)" in error and "fog" in error, error
    assert not list(folder.glob("*.exr")) + list(folder.glob("*.png"))


# Cache files


def test_cache_file(folder, capsys):
    """A cache file is created once, read the second time, and refused for another scene
    unchanged.
    """
    flags = ["-i", f"irrcache{{cache_file={folder / 'light.npz'},cache_spp=16}}", "--spp", 4]
    assert run("render", folder / "scene.xml", "-o", folder / "a.exr", *flags) == 0
    content = (folder / "light.npz").read_bytes()
    assert run("render", folder / "scene.xml", "-o", folder / "b.exr", *flags) == 0
    np.testing.assert_allclose(read(folder / "a.exr"), read(folder / "b.exr"), rtol=1e-6)
    assert (folder / "light.npz").read_bytes() == content
    capsys.readouterr()
    mi.VolumeGrid(np.ones((4, 5, 6, 1), np.float32)).write(str(folder / "density.vol"))
    assert run("render", folder / "scene.xml", "-o", folder / "c.exr", *flags) == 1
    error = capsys.readouterr().err
    assert "light.npz" in error and "medium" in error and "another scene" in error
    assert (folder / "light.npz").read_bytes() == content
    assert not (folder / "c.exr").exists()


def test_damaged_cache_file(folder, capsys):
    file = folder / "light.npz"
    file.write_bytes(b"PK\x03\x04 nothing")
    assert run("render", folder / "scene.xml", "-i", f"irrcache{{cache_file={file}}}") == 1
    assert "light.npz" in capsys.readouterr().err
    assert file.read_bytes() == b"PK\x03\x04 nothing"


def test_interrupted(folder, capsys, monkeypatch):
    """Ctrl-C during the cache build: status 130, no image, no cache file, no traceback."""
    from mitsuba_irrcache.solvers.path.solver import PathSolver

    monkeypatch.setattr(PathSolver, "refine", interrupt)
    before = set(os.listdir(folder))
    flags = ["-i", f"irrcache{{solver=path,cache_file={folder / 'light.npz'}}}"]
    assert run("render", folder / "scene.xml", "-o", folder / "a.exr", *flags) == 130
    assert "interrupted; no image was written" in capsys.readouterr().err
    assert set(os.listdir(folder)) == before


def test_interrupted_image(folder, capsys, monkeypatch):
    """Ctrl-C during rendering, which Mitsuba wraps in an error, is reported as an interrupt,
    too.
    """
    from mitsuba_irrcache.imaging import image

    monkeypatch.setattr(image, "render_film", interrupt)
    assert run("render", folder / "scene.xml", "-o", folder / "a.exr") == 130
    assert "interrupted; no image was written" in capsys.readouterr().err
    assert not (folder / "a.exr").exists()


def interrupt(*args, **kwargs):
    raise KeyboardInterrupt


# Progressive rendering


def test_budget(folder, capsys):
    """Any budget gives an image; its header holds the samples and the error."""
    flags = ["--budget", 0.01, "--spp", 2, "-i", "irrcache{solver=path,resolution=8}"]
    assert run("render", folder / "scene.xml", "-o", folder / "a.exr", *flags) == 0
    printed = capsys.readouterr().out
    assert " 4 samples per voxel, error" in printed and "wrote" in printed and "cache" in printed
    assert read(folder / "a.exr").any() and (folder / "a.png").exists()
    header = OpenImageIO.ImageInput.open(str(folder / "a.exr")).spec()
    assert ", 4 samples" in header.getattribute("irrcache:cache")
    assert header.getattribute("irrcache:seconds_image") > 0


def test_integrator_whose_prepare_builds_no_cache(folder):
    """``render`` accepts Mitsuba's differentiable integrators, whose ``prepare`` builds no
    cache.
    """
    assert run("render", folder / "scene.xml", "-i", "prbvolpath", "--spp", 1) == 0


def test_wanted_error(folder, capsys):
    flags = ["--error", 0.05, "--spp", 2, "-i", "irrcache{resolution=8}"]
    assert run("render", folder / "scene.xml", "-o", folder / "a.exr", *flags) == 0
    errors = [float(e) for e in re.findall(r"error ([\d.]+)%", capsys.readouterr().out)]
    assert errors == sorted(errors, reverse=True) and errors[-1] <= 5


@pytest.mark.parametrize("how", ["interrupt", "terminate"])
def test_a_stopped_progressive_render(folder, capsys, monkeypatch, request, how):
    """Ctrl-C or SIGTERM in a later pass: status 130, the last complete image and its cache file.

    The cache file has the samples of the image, and the message reports them.
    """
    from mitsuba_irrcache.solvers.path.solver import PathSolver

    refine, calls = PathSolver.refine, []

    def stopped(*args, **kwargs):
        calls.append(1)
        if len(calls) == 1:
            os.kill(os.getpid(), signal.SIGINT if how == "interrupt" else signal.SIGTERM)
        refine(*args, **kwargs)

    monkeypatch.setattr(PathSolver, "refine", stopped)
    # Background processes of a shell ignore Ctrl-C.
    interrupted = signal.signal(signal.SIGINT, signal.default_int_handler)
    request.addfinalizer(lambda: signal.signal(signal.SIGINT, interrupted))
    before = signal.getsignal(signal.SIGTERM)
    settings = f"solver=path,resolution=8,cache_file={folder / 'light.npz'}"
    flags = ["-i", f"irrcache{{{settings}}}", "--budget", 100]
    assert run("render", folder / "scene.xml", "-o", folder / "a.exr", *flags) == 130
    assert "interrupted; the image of 16 samples" in capsys.readouterr().err
    assert read(folder / "a.exr").any() and (folder / "a.png").exists()
    assert IrradianceCache.load(folder / "light.npz").samples == 16
    assert signal.getsignal(signal.SIGTERM) == before


def test_stopped_before_the_first_image(folder, capsys, monkeypatch):
    from mitsuba_irrcache.solvers.path.solver import Opening

    monkeypatch.setattr(Opening, "grow", interrupt)
    before = set(os.listdir(folder))
    flags = ["-i", "irrcache{solver=path}", "--budget", 9]
    assert run("render", folder / "scene.xml", "-o", folder / "a.exr", *flags) == 130
    assert "interrupted; no image was written" in capsys.readouterr().err
    assert set(os.listdir(folder)) == before


def test_errors_have_their_cause_in_scripts(folder, scenes):
    """The RuntimeError of mi.render has the package's error with its remedy as its cause."""
    (folder / "odd.xml").write_text(SCENE.replace("EXTRA", EXTRAS["medium without bounds"][0]))
    scene = mi.load_file(str(folder / "odd.xml"), integrator="irrcache")
    with pytest.raises((RuntimeError, ValueError)) as caught:
        mi.render(scene, spp=1)
    chain = [caught.value]
    while chain[-1].__cause__ is not None:
        chain.append(chain[-1].__cause__)
    assert type(chain[-1]).__name__ == "UnsupportedSceneError" and "haze" in str(chain[-1])
