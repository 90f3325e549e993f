"""Clouds of large-eddy simulations: extinction from liquid water and effective radius."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from mitsuba_irrcache.cli.main import main
from mitsuba_irrcache.errors import IrrcacheError
from mitsuba_irrcache.io.mitsuba_vol import read_vol
from mitsuba_irrcache.volumes.lengths import mass_density, metres, mixing_ratio
from mitsuba_irrcache.volumes.options import CloudVariables
from mitsuba_irrcache.volumes.readers import read_volume
from tests.support.slices import data_folder

xarray = pytest.importorskip("xarray", reason="xarray is not installed")
pytest.importorskip("h5netcdf", reason="h5netcdf is not installed")

SHAPE = (3, 4, 5)
WATER = np.linspace(0.0, 1.2, 60).reshape(SHAPE)  # g/m^3
RADIUS = np.linspace(5.0, 20.0, 60).reshape(SHAPE)  # um
#: 3 LWC / (2 rho_w r_eff), in 1/m, by hand.
EXTINCTION = 3 * WATER * 1e-3 / (2 * 1000 * RADIUS * 1e-6)


def write(path: Path, unit: str = "m", **variables) -> Path:
    """Write a data set of variables ``name=(values, unit)`` on a grid with edges of 20 units."""
    coordinates = {
        axis: (axis, 20.0 * np.arange(count), {"units": unit} if unit else {})
        for axis, count in zip("zyx", SHAPE, strict=True)
    }
    arrays = {
        name: (("z", "y", "x"), values, {"units": units} if units else {})
        for name, (values, units) in variables.items()
    }
    xarray.Dataset(arrays, coordinates).to_netcdf(path, engine="h5netcdf")
    return path


@pytest.mark.parametrize("unit", ["m", "km"])
def test_extinction_is_that_of_the_formula(tmp_path, unit):
    path = write(tmp_path / "a.nc", unit, lwc=(WATER, "g/m^3"), reff=(RADIUS, "µm"))
    volume = read_volume(path, cloud=CloudVariables())
    factor = {"m": 1, "km": 1000}[unit]
    np.testing.assert_allclose(volume.values, EXTINCTION * factor, rtol=1e-5)
    assert (volume.unit, volume.length_unit, volume.spacing) == (f"1/{unit}", unit, (20, 20, 20))


def test_extinction_is_interpolated_and_not_its_parts(tmp_path):
    """Between uneven levels at the edge of a cloud, where the radius is 0 or missing outside."""
    levels = np.array([0.0, 100.0, 200.0, 300.0, 500.0, 900.0])
    water, radius = np.zeros((6, 2, 3)), np.zeros((6, 2, 3))
    water[3:5], radius[3:5] = 1.0, 10.0
    names = {"lwc": (water, "g m-3"), "reff": (np.where(radius > 0, radius, np.nan), "um")}
    data = xarray.Dataset(
        {name: (("z", "y", "x"), v, {"units": unit}) for name, (v, unit) in names.items()}
    )
    for axis in "zyx":
        places = levels if axis == "z" else 100.0 * np.arange(data.sizes[axis])
        data[axis] = (axis, places, {"units": "m"})
    data.to_netcdf(tmp_path / "a.nc", engine="h5netcdf")
    volume = read_volume(tmp_path / "a.nc", cloud=CloudVariables())
    extinction = 3e-3 / (2 * 1000 * 10e-6)
    column = volume.values[:, 0, 0].sum() * volume.spacing[2]
    assert column == pytest.approx(extinction * (50 + 200 + 200), rel=1e-4)


@pytest.mark.parametrize(
    ("water", "radius"),
    [
        ((WATER * 1e-3, "kg m-3"), (RADIUS * 1e-6, "m")),
        ((WATER * 1e3, "mg/m3"), (RADIUS, "microns")),
        ((WATER, "g m**-3"), (RADIUS * 1e-3, "mm")),
    ],
)
def test_units_are_those_of_the_attributes(tmp_path, water, radius):
    path = write(tmp_path / "a.nc", QC=water, rel=radius)
    volume = read_volume(path, cloud=CloudVariables())
    np.testing.assert_allclose(volume.values, EXTINCTION, rtol=1e-5)


def test_mixing_ratio_is_multiplied_by_the_density_of_air(tmp_path):
    air = np.linspace(0.9, 1.2, 60).reshape(SHAPE)
    ratio = WATER / air  # g/kg
    path = write(tmp_path / "a.nc", ql=(ratio, "g/kg"), re=(RADIUS, "um"), rho=(air, "kg/m3"))
    volume = read_volume(path, cloud=CloudVariables())
    np.testing.assert_allclose(volume.values, EXTINCTION, rtol=1e-5)
    path = write(tmp_path / "b.nc", ql=(WATER, "g/kg"), re=(RADIUS, "um"))
    with pytest.raises(IrrcacheError, match=r"mixing ratio.*--air-density"):
        read_volume(path, cloud=CloudVariables())
    volume = read_volume(path, cloud=CloudVariables(air_density=0.8))
    np.testing.assert_allclose(volume.values, 0.8 * EXTINCTION, rtol=1e-5)


def test_one_radius_for_all_voxels(tmp_path):
    path = write(tmp_path / "a.nc", wet=(WATER, "g/m3"))
    volume = read_volume(path, cloud=CloudVariables(water="wet", radius=10.0))
    np.testing.assert_allclose(volume.values, 0.15 * WATER, rtol=1e-5)


def test_radius_matters_only_where_there_is_water(tmp_path):
    water, radius = WATER.copy(), RADIUS.copy()
    water[0], radius[0] = 0, 0
    path = write(tmp_path / "a.nc", lwc=(water, "g/m3"), reff=(radius, "um"))
    assert not read_volume(path, cloud=CloudVariables()).values[0].any()
    radius[1, 2, 3] = np.nan
    path = write(tmp_path / "b.nc", lwc=(water, "g/m3"), reff=(radius, "um"))
    with pytest.raises(IrrcacheError, match=r"b\.nc\[reff\] is nan um at voxel.*\(3, 2, 1\)"):
        read_volume(path, cloud=CloudVariables())


@pytest.mark.parametrize(
    ("variables", "unit", "message"),
    [
        ({"lwc": (WATER, ""), "reff": (RADIUS, "um")}, "m", r"\[lwc\] has the unit ''.*g m-3"),
        ({"lwc": (WATER, "K"), "reff": (RADIUS, "um")}, "m", r"\[lwc\] has the unit 'K'"),
        ({"lwc": (WATER, "g/m3"), "reff": (RADIUS, "")}, "m", r"\[reff\] has the unit ''"),
        ({"lwc": (WATER, "g/m3")}, "m", r"recognised as the effective radius.*'lwc'"),
        ({"wet": (WATER, "g/m3")}, "m", r"recognised as the liquid water content.*'wet'"),
        ({"lwc": (-WATER, "g/m3"), "reff": (RADIUS, "um")}, "m", r"negative, -0.0012"),
        ({"lwc": (WATER, "g/m3"), "reff": (RADIUS, "um")}, "", r"no unit of length"),
    ],
)
def test_what_has_no_extinction_is_refused(tmp_path, variables, unit, message):
    path = write(tmp_path / "a.nc", unit, **variables)
    with pytest.raises(IrrcacheError, match=rf"a\.nc.*{message}"):
        read_volume(path, cloud=CloudVariables())


def test_cloud_needs_netcdf_or_zarr(tmp_path, capsys):
    np.save(tmp_path / "a.npy", WATER)
    out = str(tmp_path / "out")
    assert main(["import", str(tmp_path / "a.npy"), "--cloud", "-o", out]) == 1
    assert "--cloud reads one NetCDF file or Zarr folder" in capsys.readouterr().err
    arguments = [str(tmp_path / "a.npy"), "--density", "--effective-radius", "9", "-o", out]
    assert main(["import", *arguments]) == 1
    assert "need --cloud" in capsys.readouterr().err


def test_imported_cloud_scatters_forward(rgb, tmp_path):
    """The scene has the phase function of droplets, all orders of scattering, and a sun."""
    import mitsuba as mi

    path = write(tmp_path / "a.nc", lwc=(WATER, "g/m3"), reff=(RADIUS, "um"))
    out = tmp_path / "out"
    assert main(["import", str(path), "--cloud", "--albedo", "0.9", "-o", str(out)]) == 0
    np.testing.assert_allclose(read_vol(out / "sigma_t.vol")[0][..., 0], EXTINCTION, rtol=1e-5)
    scene = mi.load_file(str(out / "scene.xml"), integrator="volpath")
    params = mi.traverse(scene)
    (g,) = [float(params[key][0]) for key in params.keys() if key.endswith("phase_function.g")]
    assert g == pytest.approx(0.85)
    assert "max_depth = -1" in str(scene.integrator()).replace("4294967295", "-1")
    kinds = {emitter.class_name() for emitter in scene.emitters()}
    assert kinds == {"ConstantBackgroundEmitter", "DirectionalEmitter"}


@pytest.mark.parametrize(
    ("function", "unit", "expected"),
    [
        (metres, "km", 1000),
        (metres, "μm", 1e-6),
        (metres, "degrees_north", None),
        (mass_density, "kg m^-3", 1),
        (mass_density, "g.m-3", 1e-3),
        (mass_density, "kg/kg", None),
        (mixing_ratio, "g kg**-1", 1e-3),
        (mixing_ratio, "1", 1),
    ],
)
def test_units_in_many_spellings(function, unit, expected):
    assert function(unit) == expected


@pytest.mark.data
def test_rico_cumulus_has_the_optical_depth_of_its_columns(tmp_path):
    """The optical depth of a column is 3 LWP / (2 rho_w r_eff), summed over its levels."""
    file = data_folder() / "les_rico" / "rico32x37x26.txt"
    lines = file.read_text().splitlines()
    nx, ny, nz = (int(n) for n in lines[1].split("#")[0].split(","))
    heights = [float(n) for n in lines[3].split("#")[0].strip(" ,").split(",")]
    rows = np.loadtxt(file, delimiter=",", skiprows=5)
    x, y, z = rows[:, :3].astype(int).T
    water, radius = np.zeros((nz, ny, nx)), np.zeros((nz, ny, nx))
    water[z, y, x], radius[z, y, x] = rows[:, 3], rows[:, 4]
    coordinates = {
        "z": ("z", heights, {"units": "km"}),
        "y": ("y", 0.02 * np.arange(ny), {"units": "km"}),
        "x": ("x", 0.02 * np.arange(nx), {"units": "km"}),
    }
    xarray.Dataset(
        {
            "lwc": (("z", "y", "x"), water, {"units": "g/m^3"}),
            "reff": (("z", "y", "x"), radius, {"units": "um"}),
        },
        coordinates,
    ).to_netcdf(tmp_path / "rico.nc", engine="h5netcdf")
    volume = read_volume(tmp_path / "rico.nc", cloud=CloudVariables())
    column = int(np.argmax(np.bincount(y * nx + x, weights=rows[:, 3])))
    there = y * nx + x == column
    depth = sum(1.5 * w * 40.0 / r for w, r in rows[there, 3:5])  # g/m^3 over um is 1/m
    found = volume.values[:, column // nx, column % nx].sum() * volume.spacing[2]
    np.testing.assert_allclose(found, depth, rtol=1e-4)
