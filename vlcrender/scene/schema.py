"""A scene file's keys, units and limits."""

from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from vlcrender.config.toml_model import Settings, key_error

Length = Annotated[float, Field(gt=0, le=1000)]
Reflectance = Annotated[float, Field(ge=0, le=1)]
Luminance = Annotated[float, Field(gt=0, le=1e9)]
Illuminance = Annotated[float, Field(ge=0, le=1e6)]
Count = Annotated[int, Field(ge=1, le=1000)]
Identity = Annotated[int, Field(ge=0, lt=2**31)]
Point = tuple[float, float, float]
Spectrum = Literal["LED-B1", "LED-B2", "LED-B3", "LED-B4", "LED-B5", "LED-BH1", "LED-V1", "LED-V2"]


class RoomReflectances(Settings):
    """Diffuse reflectance (albedo) of the room's surfaces, 0 to 1; none where a texture gives it."""

    floor: Reflectance | None = None
    ceiling: Reflectance | None = None
    walls: Reflectance | None = None


class TextureEntry(Settings):
    """An image whose grey values are a surface's reflectances, repeated tile by tile."""

    file: Annotated[str, Field(pattern=r"\.png$")]
    """Grey PNG of 8 or 16 bits, from the scene's folder; read linearly: 0 is black, the largest value reflects all."""
    tile_m: tuple[Length, Length]
    """What the image covers, across and down."""


class RoomTextures(Settings):
    """Images on the room's surfaces. Floor and ceiling: across is along x, down along y, from the origin.

    Walls: across is along x or y from its smallest value, down is down from the ceiling.
    """

    floor: TextureEntry | None = None
    ceiling: TextureEntry | None = None
    walls: TextureEntry | None = None


class Room(Settings):
    """A box with one corner at the origin. Each surface has either a reflectance or a texture."""

    size_m: tuple[Length, Length, Length]
    reflectance: RoomReflectances
    texture: RoomTextures = RoomTextures()


class Ambient(Settings):
    """Surrounding light: all that reaches a surface and does not come straight from an LED."""

    illuminance_lux: Illuminance
    spectrum: Spectrum


HalfPower = Annotated[float, Field(gt=5, lt=89)]


class LedFace(Settings):
    """Shape and size of an LED's face: a disc has `radius_m`, a square has `side_m`."""

    shape: Literal["disc", "square"] = "disc"
    """`"disc"`, or `"square"` with sides along x and y."""
    radius_m: Length | None = None
    """Radius of a disc, metres. A square has `side_m` instead."""
    side_m: Length | None = None
    """Whole side of a square, metres. A disc has `radius_m` instead."""
    half_power_deg: HalfPower = 60.0
    """Angle from the normal at which luminous intensity is half of I_0, degrees: I = I_0 cos^m(angle) with
    m = -ln 2 / ln cos(half_power_deg); 60 is Lambertian, m = 1."""

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
    position_m: Point
    luminance_cd_m2: Luminance
    """Seen from straight below; the same from everywhere where half_power_deg is 60."""


class PanelLeds(LedFace):
    """The two-dimensional array of LEDs on the underside of a panel, centred on it."""

    columns: Count
    rows: Count
    pitch_m: tuple[Length, Length]
    luminance_cd_m2: tuple[Luminance, Luminance]
    """Of the bare LED, also behind a diffuser; drawn evenly between the two, once and for all, by `luminance_seed`."""
    luminance_seed: Identity = 0
    first_id: Identity
    """LED (row, column) of panel (row, column): ids go up along columns first, then rows, then panels likewise."""


class PanelFrame(Settings):
    """A rim around a panel's underside, which hides LEDs from aside."""

    width_m: Length
    """Of the rim, inwards from the panel's sides; LEDs are within what it leaves open."""
    depth_m: Length
    """How far the rim stands down below the underside."""
    reflectance: Reflectance


class PanelDiffuser(Settings):
    """A translucent sheet in place of a panel's underside, which spreads what falls on it evenly (Lambert)."""

    distance_m: Length
    """How far behind the sheet the LEDs are: 3 of their radii at least, and not more than the panel is high."""
    transmittance: Annotated[float, Field(gt=0, le=1)]


class PanelGrid(Settings):
    """Equal panels on a rectangular grid; each is a box whose underside carries LEDs."""

    columns: Count
    rows: Count
    first_center_m: Point
    """Centre of the underside of the panel nearest the origin."""
    pitch_m: tuple[Length, Length]
    size_m: tuple[Length, Length, Length]
    """Along x, along y, and upwards from the underside."""
    reflectance: Reflectance
    """Of sides and underside; of a diffuser, its own."""
    frame: PanelFrame | None = None
    diffuser: PanelDiffuser | None = None
    leds: PanelLeds


class GlazingEntry(Settings):
    """A pane of glass in a wall. By Fresnel's law it mirrors and lets through what is outside."""

    wall: Literal["x=0", "x=max", "y=0", "y=max"]
    corner_m: tuple[Annotated[float, Field(ge=0)], Annotated[float, Field(ge=0)]]
    """Along the wall (x or y) and up (z), of the corner with the smallest coordinates."""
    size_m: tuple[Length, Length]
    luminance_cd_m2: Annotated[float, Field(ge=0, le=1e6)]
    """Of what is outside; the pane takes some 8 % of it."""
    refractive_index: Annotated[float, Field(ge=1, le=3)] = 1.52


class Furniture(Settings):
    """A closed mesh that occludes and reflects; it is lit where its corners run counter-clockwise."""

    file: Annotated[str, Field(pattern=r"\.(ply|obj|xml)$")]
    """PLY or OBJ, or Mitsuba XML with mesh shapes; from the scene's folder. Metres, z up."""
    position_m: Point = (0.0, 0.0, 0.0)
    """Where the file's origin stands in the room."""
    yaw_deg: Annotated[float, Field(ge=-360, le=360)] = 0.0
    scale: Annotated[float, Field(gt=0, le=1000)] = 1.0
    reflectance: Reflectance = 0.5
    """Of a PLY or OBJ; XML shapes bring their own."""


class Bake(Settings):
    """How finely the room's light is computed."""

    texel_m: Annotated[float, Field(ge=0.01, le=10)] = 0.25
    paths: Annotated[int, Field(ge=8, le=1_000_000)] = 1024
    """Light paths a texel corner, of which its Monte Carlo error comes."""


class SceneSettings(Settings):
    """A scene file."""

    format: Literal["vlcrender-scene"]
    version: Literal[1]
    name: Annotated[str, Field(min_length=1, max_length=100)]
    description: str = ""
    led_spectrum: Spectrum
    led_reflectance: Reflectance
    """Of an LED's own face, under the surrounding light."""
    room: Room
    ambient: Ambient
    led: tuple[LedEntry, ...] = ()
    panels: tuple[PanelGrid, ...] = ()
    glazing: tuple[GlazingEntry, ...] = ()
    furniture: tuple[Furniture, ...] = ()
    bake: Bake = Bake()
