"""Lightmap against closed forms: single sources, white furnace, energy balance, form factors, shadows."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from conftest import ROOT

from vlcrender.config.toml_model import check, read_toml
from vlcrender.errors import InputError
from vlcrender.light.direct_light import led_illuminance_lux
from vlcrender.light.lightmap import bake, illuminance_at, path_traced_lux, room_mesh
from vlcrender.light.mitsuba_room import mitsuba_scene
from vlcrender.scene.fresnel import glazing_reflectance
from vlcrender.scene.leds import Leds
from vlcrender.scene.loader import Scene, build_scene, load_scene
from vlcrender.scene.mesh import Mesh, join, mesh_of_surfaces
from vlcrender.scene.schema import SceneSettings
from vlcrender.scene.sources import point_sources
from vlcrender.scene.surfaces import panel_centers_m

TABLE1 = read_toml(ROOT / "scenes/table1.toml")
FACES = ("floor", "ceiling", "walls")


def scene_of(folder: Path | None = None, **changes: object) -> Scene:
    """Table 1's room with other tables."""
    return build_scene(check({**TABLE1, **changes}, SceneSettings, "test"), "test", folder or ROOT / "scenes")


def lamp(**values: object) -> dict[str, object]:
    size = {} if values.get("shape") == "square" else {"radius_m": 0.01}
    return {"id": 1, "position_m": [3.5, 3.5, 3.5], **size, "luminance_cd_m2": 10000.0, **values}


def dark_room(mesh: Mesh) -> object:
    return mitsuba_scene(mesh, np.zeros(len(mesh.vertices_m)), (), daylight=False)


def lux_on_floor(leds: Leds, x: float, y: float, scene: Scene) -> float:
    mesh = room_mesh(scene)
    return float(
        led_illuminance_lux(dark_room(mesh), np.array([[x, y, 0.0]]), np.array([[0.0, 0.0, 1.0]]), point_sources(leds))[
            0
        ]
    )


def test_below_a_disc() -> None:
    """E = pi L r^2 / (r^2 + h^2), exact for a Lambertian disc on its axis."""
    scene = scene_of(led=[lamp(radius_m=0.1)])
    expected = np.pi * 10000 * 0.1**2 / (0.1**2 + 3.5**2)
    # the small-source form leaves out r^2 beside h^2: 8e-4
    assert lux_on_floor(scene.leds, 3.5, 3.5, scene) == pytest.approx(expected, rel=1e-3)


def test_below_a_square() -> None:
    """On the axis of a square: four corner rectangles with the textbook's form factor, X = half side / height."""
    scene = scene_of(led=[lamp(side_m=0.2, shape="square")])
    x = 0.1 / 3.5
    factor = 4 / (2 * np.pi) * 2 * x / np.sqrt(1 + x**2) * np.arctan(x / np.sqrt(1 + x**2))
    # the small-source form leaves out 4/3 X^2 = 1.1e-3
    assert lux_on_floor(scene.leds, 3.5, 3.5, scene) == pytest.approx(np.pi * 10000 * factor, rel=1.5e-3)


def test_illuminance_off_the_axis_falls_with_cos4() -> None:
    scene = scene_of(led=[lamp()])
    straight = lux_on_floor(scene.leds, 3.5, 3.5, scene)
    beside = lux_on_floor(scene.leds, 3.5 + 3.5 * np.tan(np.radians(30)), 3.5, scene)
    assert beside / straight == pytest.approx(np.cos(np.radians(30)) ** 4, rel=1e-4)


@pytest.mark.parametrize("half_power_deg", [20.0, 45.0, 60.0, 75.0])
def test_intensity_falls_to_half_at_the_half_power_angle(half_power_deg: float) -> None:
    # a point at that angle on a surface that faces the LED: E d^2 is the intensity
    scene = scene_of(led=[lamp(half_power_deg=half_power_deg)])
    angle = np.radians(half_power_deg)
    direction = np.array([np.sin(angle), 0.0, -np.cos(angle)])
    points = np.array([[3.5, 3.5, 3.5 - 1.0], [3.5, 3.5, 3.5] + direction])
    normals = np.array([[0.0, 0.0, 1.0], -direction])
    straight, aside = led_illuminance_lux(dark_room(room_mesh(scene)), points, normals, point_sources(scene.leds))
    assert aside / straight == pytest.approx(0.5, rel=1e-6)


@pytest.mark.parametrize("half_power_deg", [30.0, 60.0])
def test_all_light_of_the_leds_falls_on_the_room(half_power_deg: float) -> None:
    """Flux of an LED of order m: 2 pi I_0 / (m + 1). The vertices' trapezoidal sum, at 0.1 m."""
    scene = scene_of(led=[lamp(half_power_deg=half_power_deg)])
    mesh = mesh_of_surfaces(scene.surfaces, 0.1)
    lux = led_illuminance_lux(dark_room(mesh), mesh.probes_m, mesh.normals, point_sources(scene.leds))
    order = scene.leds.orders[0]
    flux = 2 * np.pi * 10000 * np.pi * 0.01**2 / (order + 1)
    # second-order rule on 0.1 m texels of a pattern some 3.5 m wide: (0.1 / 3.5)^2 = 8e-4, and the probes' inset
    assert (lux * mesh.areas_m2()).sum() == pytest.approx(flux, rel=5e-3)


@pytest.mark.parametrize("albedo", [0.0, 0.5, 0.8, 0.95, pytest.param(0.99, marks=pytest.mark.slow)])
def test_white_furnace(albedo: float) -> None:
    """A flux that falls evenly on a closed room of one reflectance: E = flux rho / (S (1 - rho)), reflected part alone.

    The surfaces emit what they reflect of the flux at once: luminance is rho flux / (pi S), here 1 cd/m2 (of a black
    room, whose surfaces emit by themselves, too).
    """
    scene = scene_of(led=[lamp()])
    mesh = mesh_of_surfaces(scene.surfaces, 3.5)  # 320 vertices
    mesh = dataclasses.replace(mesh, albedo=np.full(len(mesh.vertices_m), albedo))
    glowing = mitsuba_scene(mesh, np.ones(len(mesh.vertices_m)), (), daylight=False)
    lux, sigma = path_traced_lux(glowing, mesh.probes_m, mesh.normals, 2048, lambda share: None)
    expected = np.pi / (1 - albedo)  # flux rho / S = pi
    n = len(lux)
    # The standard errors come from 8 batches: z follows Student's t with 7 degrees of freedom, variance 7/5.
    z = (lux - expected) / np.maximum(sigma, 1e-5 * expected)
    assert abs(z.mean()) < 5 * np.sqrt(7 / 5 / n)
    # The standard errors are neither too small nor too large. Fourth moment of t: 3 * 7^2 / ((7 - 2) (7 - 4)) = 9.8.
    # Without reflections every path has the same luminance, and no error.
    assert albedo == 0 or abs((z**2).mean() - 7 / 5) < 5 * np.sqrt((9.8 - (7 / 5) ** 2) / n)
    # The sum over a path of up to infinitely many bounces, each survived with probability rho after the first ones, is
    # at most geometric: its standard deviation is below its mean. All 2048 n paths are independent.
    assert lux.mean() == pytest.approx(expected, rel=5 / np.sqrt(2048 * n) + 1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("reflectance", [None, 0.5, 0.95])
def test_energy_balance(tmp_path: Path, reflectance: float | None) -> None:
    """The surfaces absorb the flux that the LEDs emit; None stands for the reflectances of Table 1's room."""
    finish = {"floor": 0.2, "ceiling": 0.8, "walls": 0.5} if reflectance is None else dict.fromkeys(FACES, reflectance)
    room = {"size_m": [7.0, 7.0, 3.5], "reflectance": finish}
    scene = scene_of(led=[lamp(position_m=[3.5, 3.5, 3.0])], room=room, bake={"texel_m": 0.2, "paths": 64})
    light = bake(scene, tmp_path)
    count = len(light.mesh.vertices_m)
    absorbed = ((1 - light.mesh.albedo) * light.led_lux[:count] * light.mesh.areas_m2()).sum()
    flux = np.pi * 10000 * np.pi * 0.01**2
    # the quadrature's half per cent, as for direct light; Monte Carlo adds 64 * 5000 paths: 0.18 %
    assert absorbed == pytest.approx(flux, rel=0.01)


def test_a_room_that_absorbs_no_light_is_refused(tmp_path: Path) -> None:
    """Paths in a room of reflectance 1 all round never end. A little absorption, or furniture, is enough."""

    def room(floor: float) -> dict[str, object]:
        return {"size_m": [7.0, 7.0, 3.5], "reflectance": {"floor": floor, "ceiling": 1.0, "walls": 1.0}}

    message = r"reflectance: all surfaces together absorb 0\.000% of the light on them; at least 0\.1% is needed"
    with pytest.raises(InputError, match=rf"^test: {message}"):
        scene_of(led=[lamp()], room=room(1.0))
    scene_of(led=[lamp()], room=room(0.99))  # absorbs 0.01 * 49 of 196 m2: 0.25 %
    glazing = {"wall": "x=0", "corner_m": [2.5, 1.0], "size_m": [2.0, 1.5], "luminance_cd_m2": 0.0}
    scene_of(led=[lamp()], room=room(1.0), glazing=[glazing])
    (tmp_path / "table.obj").write_text("v 3 3 1\nv 4 3 1\nv 4 4 1\nv 3 4 1\nf 1 2 3 4\n")
    bake_settings = {"texel_m": 5.0, "paths": 8}
    white, grey = (
        scene_of(tmp_path, led=[lamp()], room=room(1.0), furniture=[piece], bake=bake_settings)
        for piece in ({"file": "table.obj", "reflectance": reflectance} for reflectance in (1.0, 0.5))
    )
    with pytest.raises(InputError, match=rf"^scene 'table1': {message}"):
        bake(white, tmp_path)
    bake(grey, tmp_path)  # absorbs 0.5 of 197 m2


@pytest.mark.slow
def test_light_reflected_by_the_floor_onto_the_ceiling_agrees_with_a_form_factor(tmp_path: Path) -> None:
    """One bounce by hand: only the floor reflects; the ceiling gets rho E / pi * cos cos / d^2 of each part of it."""
    reflectance = {"floor": 0.5, "ceiling": 0.0, "walls": 0.0}
    scene = scene_of(led=[lamp()], room={"size_m": [7.0, 7.0, 3.5], "reflectance": reflectance}, bake={"paths": 512})
    light = bake(scene, tmp_path)
    step = 7.0 / 70
    x, y = np.meshgrid(*[(np.arange(70) + 0.5) * step] * 2)  # the rule errs by (0.1 / 3.5)^2 = 8e-4
    intensity = 10000 * np.pi * 0.01**2
    d2 = (x - 3.5) ** 2 + (y - 3.5) ** 2 + 3.5**2
    floor = intensity * (3.5 / np.sqrt(d2)) ** 2 / d2
    ceiling = np.flatnonzero(np.isclose(light.mesh.vertices_m[:, 2], 3.5) & (light.mesh.normals[:, 2] == -1))
    px, py = light.mesh.probes_m[ceiling, :2].T
    expected = np.empty(len(ceiling))
    for k in range(len(ceiling)):
        back2 = (x - px[k]) ** 2 + (y - py[k]) ** 2 + 3.5**2
        expected[k] = (0.5 * floor / np.pi * (3.5**2 / back2) / back2).sum() * step**2
    ratio, sigma = light.led_lux[ceiling] / expected - 1, light.sigma_lux[ceiling] / expected
    ring = np.digitize(np.hypot(px - 3.5, py - 3.5), [1.0, 2.0, 3.0, 4.0])
    for which in range(5):
        chosen = ring == which
        # 5 sigma of the bake, and 1 % for the floor's linear interpolation between vertices 0.25 m apart
        noise = np.sqrt((sigma[chosen] ** 2).sum()) / chosen.sum()
        assert noise < 0.01
        assert abs(ratio[chosen].mean()) < 5 * noise + 0.01


def test_furniture_casts_a_shadow_and_reflects(tmp_path: Path) -> None:
    """A table between LED and floor: dark below, light around as before, and its top is lit."""
    vertices = np.array([[-0.5, -0.5, 0], [0.5, -0.5, 0], [0.5, 0.5, 0], [-0.5, 0.5, 0]])
    text = "".join(f"v {x} {y} {z}\n" for x, y, z in vertices) + "f 1 2 3\nf 1 3 4\n"
    (tmp_path / "table.obj").write_text(text)
    piece = {"file": "table.obj", "position_m": [3.5, 3.5, 0.75], "reflectance": 0.3}
    scene = scene_of(tmp_path, led=[lamp()], furniture=[piece])
    mesh = room_mesh(scene)
    blockers = dark_room(mesh)
    # the shadow on the floor ends at 0.5 * 3.5 / 2.75 = 0.636 m from the middle
    points = np.array([[3.5, 3.5, 0.0], [3.5 + 0.62, 3.5, 0.0], [3.5 + 0.66, 3.5, 0.0], [3.5, 3.6, 0.75]])
    lux = led_illuminance_lux(blockers, points, np.tile([0.0, 0.0, 1.0], (4, 1)), point_sources(scene.leds))
    assert lux[:2].tolist() == [0.0, 0.0]
    alone = scene_of(led=[lamp()])
    assert lux[2] == pytest.approx(lux_on_floor(alone.leds, 4.16, 3.5, alone))
    assert lux[3] > 0
    assert mesh.owners.max() == len(scene.surfaces)
    top = mesh.owners == len(scene.surfaces)
    assert set(mesh.albedo[mesh.faces[top]].ravel().round(6)) == {0.3}


@pytest.mark.slow
def test_daylight_through_glazing_agrees_with_form_factors(tmp_path: Path) -> None:
    """E at a point opposite the middle of a rectangle, 4 corner form factors; the room is black."""
    black = {"floor": 0.0, "ceiling": 0.0, "walls": 0.0}
    glazing = {"wall": "x=0", "corner_m": [2.5, 1.0], "size_m": [2.0, 1.5], "luminance_cd_m2": 2000.0}
    scene = scene_of(
        led=[lamp()], glazing=[glazing], room={"size_m": [7.0, 7.0, 3.5], "reflectance": black}, bake={"texel_m": 1.4}
    )
    light = bake(scene, tmp_path)
    point = np.argmin(np.linalg.norm(light.mesh.vertices_m - [7.0, 3.5, 1.75], axis=1))
    _, y, z = light.mesh.probes_m[point]
    expected = 0.0
    for dy in (y - 2.5, 4.5 - y):
        for dz in (z - 1.0, 2.5 - z):
            a, b = dy / 7.0, dz / 7.0
            expected += (
                a / np.sqrt(1 + a * a) * np.arctan(b / np.sqrt(1 + a * a))
                + b / np.sqrt(1 + b * b) * np.arctan(a / np.sqrt(1 + b * b))
            ) / (2 * np.pi)
    # thin glazing of index 1.52 reflects F = (0.52 / 2.52)^2 at each face, 2 F / (1 + F) = 8.2 %, to 1e-3 up to 20 deg
    face = (0.52 / 2.52) ** 2
    through = np.pi * 2000 * expected * (1 - 2 * face / (1 + face))
    ambient = scene.settings.ambient.illuminance_lux
    assert abs(light.ambient_lux[point] - ambient - through) < 5 * light.sigma_lux[point] + 2e-3 * through


MIRROR = {"wall": "x=0", "corner_m": [3.0, 0.5], "size_m": [1.0, 2.5], "luminance_cd_m2": 0.0}


@pytest.mark.parametrize(("y", "mirrored"), [(3.5, True), (3.1, True), (1.9, False), (5.1, False)])
def test_glazing_reflects_an_led_onto_points_that_its_mirror_image_sees_through_it(y: float, mirrored: bool) -> None:
    """LED at x = 2, its image at x = -2; its ray to the point at x = 2 crosses the wall at (y + 3.5) / 2."""
    scene = scene_of(led=[lamp(position_m=[2.0, 3.5, 3.5])], glazing=[MIRROR])
    blockers, sources = dark_room(room_mesh(scene)), point_sources(scene.leds)
    point, up = np.array([[2.0, y, 0.0]]), np.array([[0.0, 0.0, 1.0]])
    straight = led_illuminance_lux(blockers, point, up, sources)[0]
    by_glazing = led_illuminance_lux(blockers, point, up, sources, scene.glazings)[0] - straight
    d2 = 4.0**2 + (y - 3.5) ** 2 + 3.5**2
    lux = 10000 * np.pi * 0.01**2 * (3.5**2 / d2) / d2 * glazing_reflectance(4.0 / np.sqrt(d2), 1.52, np.sqrt)
    # shadow rays start 0.1 mm off, which matters within 0.1 mm of the glazing's border only
    assert by_glazing == pytest.approx(lux if mirrored else 0.0, rel=1e-9, abs=1e-12)


@pytest.mark.parametrize("x", [0.5, 1.5])
def test_a_board_blocks_reflected_light_before_and_after_the_glazing(tmp_path: Path, x: float) -> None:
    """The path is 3.5 m down over 4 m across: at x = 1.5, z is 0.44 m before the glazing and 3.06 m after it."""
    for z, covers in ((3.5 * (2 - x) / 4, True), (3.5 * (2 + x) / 4, True), (0.1, False)):
        vertices = [(x - 0.1, 3.4), (x + 0.1, 3.4), (x + 0.1, 3.6), (x - 0.1, 3.6)]
        (tmp_path / "b.obj").write_text("".join(f"v {a} {b} {z}\n" for a, b in vertices) + "f 1 2 3\nf 1 3 4\n")
        led, furniture = lamp(position_m=[2.0, 3.5, 3.5]), {"file": "b.obj"}
        scene = scene_of(tmp_path, led=[led], glazing=[MIRROR], furniture=[furniture])
        blockers, sources = dark_room(room_mesh(scene)), point_sources(scene.leds)
        arguments = blockers, np.array([[2.0, 3.5, 0.0]]), np.array([[0.0, 0.0, 1.0]]), sources
        by_glazing = led_illuminance_lux(*arguments, scene.glazings)[0] - led_illuminance_lux(*arguments)[0]
        assert (by_glazing == 0) == covers


def test_the_mesh_has_holes_under_panels(office: Scene) -> None:
    mesh = mesh_of_surfaces(office.surfaces, 0.25)
    area = mesh.areas_m2().sum()
    # floor, walls, ceiling, and the panels' sides; their undersides fill the holes they cut into the ceiling
    assert area == pytest.approx(2 * 49 + 4 * 24.5 + 49 * 4 * 0.6 * 0.05)


@pytest.mark.parametrize("texel_m", [0.06, 0.25, 1.0])
def test_probes_are_on_the_lit_side_of_panels_and_walls(office: Scene, texel_m: float) -> None:
    """A probe inside a panel is dark, and darkens the ceiling around the panel's corner."""
    mesh = mesh_of_surfaces(office.surfaces[:2], texel_m, leds_m=office.leds.centers_m)
    assert ((mesh.probes_m[:, :2] > 0) & (mesh.probes_m[:, :2] < 7)).all()
    x, y, _ = mesh.probes_m[mesh.normals[:, 2] < 0].T
    for cx, cy, _ in panel_centers_m(office.settings.panels[0]):
        assert not ((np.abs(x - cx) < 0.3) & (np.abs(y - cy) < 0.3)).any()


def test_texels_are_fine_at_contacts_and_coarse_elsewhere(tmp_path: Path, office: Scene) -> None:
    """A fifth of a texel beside walls and panels, a quarter around furniture's feet, never more than a texel."""

    def steps(scene: Scene, name: str, axis: int) -> tuple[np.ndarray, np.ndarray]:
        """Positions between the vertices of a surface along x, y or z, and the distances of the vertices."""
        mesh = room_mesh(scene)
        (number,) = (i for i, surface in enumerate(scene.surfaces) if surface.name == name)
        cuts = np.unique(mesh.vertices_m[mesh.faces[mesh.owners == number]][..., axis].round(9))
        return (cuts[1:] + cuts[:-1]) / 2, np.diff(cuts)

    at, step = steps(office, "ceiling", 0)
    assert step.max() <= 0.25 + 1e-9
    beside = [np.abs(at - x).argmin() for x in (0.0, 0.2 - 1e-6, 0.8 + 1e-6, 1.2 - 1e-6)]
    assert step[beside].max() < 0.2 * 0.25
    assert step[(at > 3.2) & (at < 3.8)].min() > 0.19  # over a panel: 0.6 m
    (tmp_path / "box.obj").write_text(
        "v 2 2 0\nv 3 2 0\nv 3 3 0\nv 2 3 0\nv 2 2 1\nf 1 2 5\nf 2 3 5\nf 3 4 5\nf 4 1 5\n"
    )
    at, step = steps(scene_of(tmp_path, led=[lamp()], furniture=[{"file": "box.obj"}]), "floor", 1)
    assert step[(at > 2.05) & (at < 2.95)].max() < 0.25 / 4 + 1e-9
    assert step.max() > 0.24


@pytest.mark.slow
def test_interpolated_light_between_panels_is_the_light_there(office: Scene) -> None:
    """Light of LEDs on the ceiling between panels and between panels and walls, traced to random points.

    There it falls from the middle of a gap to a panel's side by 15 % over 5 cm, and towards a wall by 25 %.
    """
    light = bake(office)
    rng = np.random.default_rng(1)
    number = [surface.name for surface in office.surfaces].index("ceiling")
    faces = light.mesh.faces[light.mesh.owners == number]
    corners = light.mesh.vertices_m[faces]
    areas = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    picked = rng.choice(len(faces), 1000, p=areas / areas.sum())
    shares = rng.dirichlet((1.0, 1.0, 1.0), len(picked))  # even over a triangle
    points = np.einsum("ni,nij->nj", shares, corners[picked])
    true = illuminance_at(office, light.mesh, points, np.tile([0.0, 0.0, -1.0], (len(points), 1)), 1024)
    interpolated = (shares * light.led_lux[faces[picked]]).sum(axis=1)
    by_the_wall = ((points[:, :2] < 0.2) | (points[:, :2] > 6.8)).any(axis=1)
    for here in (by_the_wall, ~by_the_wall):
        weights = np.bincount(faces[picked[here]].ravel(), shares[here].ravel(), minlength=len(light.sigma_lux))
        noise = np.sqrt(((weights * light.sigma_lux) ** 2).sum() + (true.sigma_lux[here] ** 2).sum()) / here.sum()
        mean = true.led_lux[here].mean()
        # the 1 %, and noise; each sigma comes from 8 batches, but the sums of hundreds are Gaussian
        assert abs((interpolated - true.led_lux)[here].mean()) < 0.01 * mean + 5 * noise


def test_joined_meshes_keep_their_faces() -> None:
    scene = load_scene(ROOT / "scenes/table1.toml")
    one = mesh_of_surfaces(scene.surfaces[:1], 1.0)
    two = join([one, one])
    assert np.array_equal(two.faces[len(one.faces) :], one.faces + len(one.vertices_m))
