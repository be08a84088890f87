"""The keys of a scene file, with their units and limits."""

from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from vlcrender.config.toml_model import Settings, key_error
from vlcrender.core.face_profile import lowest_share
from vlcrender.modulation.keys import Downlink

Length = Annotated[float, Field(gt=0, le=1000)]
Reflectance = Annotated[float, Field(ge=0, le=1)]
Luminance = Annotated[float, Field(gt=0, le=1e9)]
Illuminance = Annotated[float, Field(ge=0, le=1e6)]
HalfPower = Annotated[float, Field(gt=5, lt=89)]
Gradient = Annotated[float, Field(ge=-1, le=1)]
Count = Annotated[int, Field(ge=1, le=1000)]
Identity = Annotated[int, Field(ge=0, lt=2**31)]
Point = tuple[float, float, float]
Spectrum = Literal["LED-B1", "LED-B2", "LED-B3", "LED-B4", "LED-B5", "LED-BH1", "LED-V1", "LED-V2"]


class RoomReflectances(Settings):
    """Diffuse reflectances (albedos) of the room's surfaces. A surface with a texture has no reflectance here."""

    floor: Reflectance | None = None
    """Diffuse reflectance of the floor: 0 absorbs all light, 1 reflects all."""
    ceiling: Reflectance | None = None
    """Diffuse reflectance of the ceiling, 0 to 1."""
    walls: Reflectance | None = None
    """Diffuse reflectance of all four walls, 0 to 1."""


class TextureEntry(Settings):
    """An image whose grey values are a surface's reflectances, repeated tile by tile."""

    file: Annotated[str, Field(pattern=r"\.png$")]
    """Grey PNG of 8 or 16 bits without transparency, a path inside the scene's folder. Values are linear: 0 reflects
    nothing, the largest value reflects all light."""
    tile_m: tuple[Length, Length]
    """Width and height that the image covers on the surface, metres."""


class RoomTextures(Settings):
    """Images on the room's surfaces.

    Floor and ceiling: the image's rows run along x and its columns along y, from the origin. Walls: rows run along x or
    y from its smallest value, columns run down from the ceiling.
    """

    floor: TextureEntry | None = None
    """Image on the floor, in place of `room.reflectance.floor`."""
    ceiling: TextureEntry | None = None
    """Image on the ceiling, in place of `room.reflectance.ceiling`."""
    walls: TextureEntry | None = None
    """Image on each of the four walls, in place of `room.reflectance.walls`."""


class Room(Settings):
    """A box with a floor corner at the origin. Each surface has either a reflectance or a texture."""

    size_m: tuple[Length, Length, Length]
    """Extent along x, y and z (up), metres."""
    reflectance: RoomReflectances
    """Reflectances of the surfaces without a texture."""
    texture: RoomTextures = RoomTextures()
    """Images on surfaces."""


class Ambient(Settings):
    """Ambient light: the same illuminance on every surface, its reflections included, from no particular source."""

    illuminance_lux: Illuminance
    """Illuminance on every surface, lux. 0 for a room lit by LEDs alone."""
    spectrum: Spectrum
    """Spectrum of the ambient light: a CIE LED illuminant (CIE 15:2018)."""


class LedFace(Settings):
    """Shape, size, beam and luminance profile of an LED's flat face: a disc has `radius_m`, a square has `side_m`."""

    shape: Literal["disc", "square"] = "disc"
    """`"disc"`, or `"square"` with sides along x and y."""
    radius_m: Length | None = None
    """Radius of a disc, metres. A square has `side_m` instead."""
    side_m: Length | None = None
    """Whole side of a square, metres. A disc has `radius_m` instead."""
    half_power_deg: HalfPower = 60.0
    """Angle from the normal at which luminous intensity is half of its maximum I_0, degrees: I = I_0 cos^m(angle) with
    m = -ln 2 / ln cos(half_power_deg). 60 is a Lambertian LED, m = 1."""
    face_gradient: tuple[Gradient, Gradient] = (0.0, 0.0)
    """Relative rise of luminance from the face's centre to its border along x and along y, each -1 to 1. The mean
    luminance stays. Not behind a diffuser."""
    face_falloff: Annotated[float, Field(ge=0, le=2)] = 1.0
    """Luminance at the rim of a disc, or in the middle of a square's sides, over that at the face's centre, 0 to 2; it
    falls with the square of the distance from the centre. The mean luminance stays. 1 is an even face. Not behind a
    diffuser."""

    @model_validator(mode="after")
    def _size_key_fits_the_shape(self) -> Self:
        if self.shape == "disc":
            if self.side_m is not None:
                raise key_error("side_m", 'is for squares; a disc has radius_m, or write shape = "square"')
            if self.radius_m is None:
                raise key_error("radius_m", "is missing")
        else:
            if self.radius_m is not None:
                raise key_error(
                    "radius_m", "is for discs; a square has side_m, its whole side (twice the old radius_m)"
                )
            if self.side_m is None:
                raise key_error("side_m", "is missing")
        return self

    @model_validator(mode="after")
    def _no_point_of_the_face_is_darker_than_black(self) -> Self:
        lowest = lowest_share(self.face_gradient, self.face_falloff, self.shape == "square")
        if lowest < -1e-12:
            raise key_error(
                "face_gradient",
                f"with face_falloff = {self.face_falloff:g}, luminance falls to {lowest:.3g} of its mean on the face; "
                "at least 0 is allowed: take a smaller gradient, or a face_falloff closer to 1",
            )
        return self

    @property
    def even(self) -> bool:
        """Whether the luminance is the same all over the face."""
        return self.face_gradient == (0.0, 0.0) and self.face_falloff == 1.0

    @property
    def half_width_m(self) -> float:
        """Radius of a disc, half the side of a square, metres."""
        if self.shape == "disc":
            assert self.radius_m is not None  # _size_key_fits_the_shape
            return self.radius_m
        assert self.side_m is not None
        return self.side_m / 2


class LedEntry(LedFace):
    """One LED: flat, facing down."""

    id: Identity
    """Identity that the LED transmits: an integer that no other LED of the scene has."""
    position_m: Point
    """Centre of the face, x, y, z in metres, in the room."""
    luminance_cd_m2: Luminance
    """Luminance along the normal (straight down), cd/m2; the mean over time. The same from every direction for
    half_power_deg = 60."""
    downlink: Downlink | None = None
    """What the LED transmits; steady light without this table."""


class PanelLeds(LedFace):
    """The two-dimensional array of equal LEDs on the underside of a panel, centred on it."""

    columns: Count
    """LEDs along x on each panel."""
    rows: Count
    """LEDs along y on each panel."""
    pitch_m: tuple[Length, Length]
    """Distance between the centres of neighbouring LEDs along x and along y, metres."""
    luminance_cd_m2: tuple[Luminance, Luminance]
    """Lowest and highest luminance along the normal, cd/m2, of the bare LED (also behind a diffuser). Each LED's
    luminance is drawn uniformly between the two with `luminance_seed`."""
    luminance_seed: Identity = 0
    """Seed of the LEDs' luminances: the same seed gives the same luminances in every dataset."""
    first_id: Identity
    """Identity of the first LED. Identities count up along the columns of a panel, then its rows, then along the
    columns of panels, then their rows."""


class PanelFrame(Settings):
    """A rim around a panel's underside. It hides LEDs from cameras far to the side."""

    width_m: Length
    """Width of the rim from the panel's sides inwards, metres. The LEDs fit into the opening that it leaves."""
    depth_m: Length
    """Height of the rim, which hangs down from the underside, metres."""
    reflectance: Reflectance
    """Diffuse reflectance of the rim, 0 to 1."""


class PanelDiffuser(Settings):
    """A Lambertian diffuser in place of a panel's underside: it spreads the light that it transmits evenly."""

    distance_m: Length
    """Distance of the LEDs behind the diffuser, metres: at least 3 LED radii (or half sides), at most the panel's
    height."""
    transmittance: Annotated[float, Field(gt=0, le=1)]
    """Share of the LEDs' light that the diffuser transmits, above 0 to 1."""


class PanelGrid(Settings):
    """Equal panels on a rectangular grid. Each panel is a box with LEDs on its underside."""

    columns: Count
    """Panels along x."""
    rows: Count
    """Panels along y."""
    first_center_m: Point
    """Centre of the underside of the panel nearest the origin, x, y, z in metres."""
    pitch_m: tuple[Length, Length]
    """Distance between the centres of neighbouring panels along x and along y, metres; at least the panels' size."""
    size_m: tuple[Length, Length, Length]
    """Extent of a panel along x, along y, and upwards from its underside, metres."""
    reflectance: Reflectance
    """Diffuse reflectance of the panel's sides and underside; of its diffuser, where it has one. 0 to 1."""
    frame: PanelFrame | None = None
    """The rim around each panel's underside; no rim without this table."""
    diffuser: PanelDiffuser | None = None
    """The diffuser before the LEDs of each panel; bare LEDs without this table."""
    downlink: Downlink | None = None
    """What the panel's LEDs transmit; steady light without this table."""
    leds: PanelLeds
    """The LEDs of each panel."""

    @model_validator(mode="after")
    def _leds_of_a_panel_have_tones_of_their_own(self) -> Self:
        if self.downlink is not None and self.downlink.send == "tone" and self.downlink.frequency_hz is not None:
            raise key_error(
                "downlink.frequency_hz", "is the tone of a single LED; the tones of panels are first_hz, step_hz"
            )
        return self

    @model_validator(mode="after")
    def _faces_behind_a_diffuser_are_even(self) -> Self:
        if self.diffuser is not None and not self.leds.even:
            raise key_error(
                "diffuser", "hides the LEDs' faces: remove it, or remove face_gradient and face_falloff from its LEDs"
            )
        return self


class GlazingEntry(Settings):
    """Glazing in a wall: thin glass. It reflects by Fresnel's equations and transmits daylight from outside."""

    wall: Literal["x=0", "x=max", "y=0", "y=max"]
    """The wall with the glazing: `"x=0"`, `"x=max"`, `"y=0"` or `"y=max"`."""
    corner_m: tuple[Annotated[float, Field(ge=0)], Annotated[float, Field(ge=0)]]
    """Corner with the smallest coordinates: position along the wall (x or y) and height (z), metres."""
    size_m: tuple[Length, Length]
    """Extent along the wall and upwards, metres."""
    luminance_cd_m2: Annotated[float, Field(ge=0, le=1e6)]
    """Luminance of the scene outside, cd/m2. Ordinary glass transmits about 92 % of it. 0 at night."""
    refractive_index: Annotated[float, Field(ge=1, le=3)] = 1.52
    """Refractive index of the glass; 1 reflects nothing."""


class Furniture(Settings):
    """A mesh that occludes LEDs and reflects light. A closed mesh is lit on its outside, an open one on both sides."""

    file: Annotated[str, Field(pattern=r"\.(ply|obj|xml)$")]
    """PLY, OBJ, or Mitsuba XML; a path inside the scene's folder. Metres (see `scale`), z up. XML may hold the shapes
    ply, obj, serialized, cube and rectangle with diffuse BSDFs, of a number, an rgb, a bitmap or a checkerboard."""
    position_m: Point = (0.0, 0.0, 0.0)
    """Position of the file's origin in the room, x, y, z in metres."""
    yaw_deg: Annotated[float, Field(ge=-360, le=360)] = 0.0
    """Rotation about the file's z axis, degrees, counter-clockwise as seen from above."""
    scale: Annotated[float, Field(gt=0, le=1000)] = 1.0
    """Factor from the file's unit to metres, applied before rotation and position; 0.001 for millimetres."""
    reflectance: Reflectance = 0.5
    """Diffuse reflectance of a PLY or OBJ, 0 to 1. The shapes of an XML file have their own."""


class Bake(Settings):
    """Resolution and accuracy of the lightmap."""

    texel_m: Annotated[float, Field(ge=0.01, le=10)] = 0.25
    """Largest distance between neighbouring vertices of the lightmap's mesh, metres. Illuminance is linear in
    between. Where surfaces meet the distance is 0.12 of it, and it grows from there."""
    paths: Annotated[int, Field(ge=8, le=1_000_000)] = 1024
    """Light paths traced from each vertex for reflected light and daylight. Their Monte Carlo error falls with
    1 / sqrt(paths)."""


class SceneSettings(Settings):
    """A scene file."""

    format: Literal["vlcrender-scene"]
    """Always `"vlcrender-scene"`."""
    version: Literal[1]
    """Version of the scene format: 1."""
    name: Annotated[str, Field(min_length=1, max_length=100)]
    """Short name of the scene, 1 to 100 characters."""
    description: str = ""
    """One line about the scene."""
    led_spectrum: Spectrum
    """Spectrum of all LEDs: a CIE LED illuminant (CIE 15:2018)."""
    led_reflectance: Reflectance
    """Diffuse reflectance of the LEDs' faces, 0 to 1: an LED reflects the light of the room in addition to its own."""
    room: Room
    """Size and surfaces of the room."""
    ambient: Ambient
    """Ambient light."""
    led: tuple[LedEntry, ...] = ()
    """Single LEDs, one `[[led]]` each."""
    panels: tuple[PanelGrid, ...] = ()
    """Grids of panels with arrays of LEDs, one `[[panels]]` each."""
    glazing: tuple[GlazingEntry, ...] = ()
    """Glazing in walls, one `[[glazing]]` each."""
    furniture: tuple[Furniture, ...] = ()
    """Furniture, one `[[furniture]]` a file."""
    bake: Bake = Bake()
    """Texel size and number of light paths of the bake."""
