"""The keys of a `downlink` table: what the LEDs of a panel, or a single LED, transmit."""

from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from vlcrender.config.toml_model import Settings, key_error

Send = Literal["code", "packet", "tone", "steady", "pwm", "mains"]
Frequency = Annotated[float, Field(gt=0, le=1e6)]

DEFAULT_CHIP_US = {"code": 25.0, "packet": 50.0}
DEFAULT_FREQUENCY_HZ = {"pwm": 1000.0, "mains": 50.0}
MAX_TONE_HZ = 7000.0
"""Highest tone of a panel: tones beyond it start at `first_hz` again."""
KEYS_OF = {
    "code": ("chip_us", "code_length", "depth", "clock_error"),
    "packet": ("chip_us", "depth", "clock_error", "delays"),
    "tone": ("duty", "depth", "clock_error", "first_hz", "step_hz", "frequency_hz"),
    "steady": (),
    "pwm": ("frequency_hz", "duty", "depth", "clock_error"),
    "mains": ("frequency_hz", "depth", "clock_error"),
}
"""The keys beside `send` that each wave has."""
IDENTIFYING: tuple[Send, ...] = ("code", "packet", "tone")
"""Waves that tell a receiver which LED it sees."""


class Downlink(Settings):
    """The wave of an LED's light. Its mean is the LED's luminance, whatever it transmits.

    A key that the wave does not have is refused.
    """

    send: Send = "code"
    """`"code"`: each LED repeats a code of its own. `"packet"`: a panel's LEDs repeat the coordinates of its centre.
    `"tone"`: a square wave of a frequency of its own. Waves that identify no LED: `"steady"`, `"pwm"` (dimming by pulse
    width) and `"mains"` (ripple at twice the line frequency)."""
    chip_us: Annotated[float, Field(ge=1, le=10_000)] | None = None
    """Duration of a chip of codes and packets, microseconds. 25 for codes and 50 for packets where not given."""
    code_length: Annotated[int, Field(ge=8, le=256, multiple_of=2)] | None = None
    """Chips of a code. 32 where not given."""
    duty: Annotated[float, Field(ge=0.01, le=0.99)] | None = None
    """Lit share of the period of tones and pulse-width modulation. 0.5 where not given."""
    depth: Annotated[float, Field(gt=0, le=1)] | None = None
    """Depth of modulation: the dark level is 1 - depth of the lit one; of mains ripple, its amplitude over the mean. 1
    where not given."""
    clock_error: Annotated[float, Field(ge=0, le=0.01)] | None = None
    """Standard deviation of the relative error of the clock's rate. A panel, or a single LED, has one clock; lamps on
    the mains share one. 1e-4 where not given."""
    delays: Literal["by-index", "common"] | None = None
    """Packets: `"by-index"` starts each LED's packet a number of chips later that tells which LED of the panel it is;
    `"common"` starts all at once. `"by-index"` where not given."""
    first_hz: Annotated[float, Field(ge=100, le=MAX_TONE_HZ)] | None = None
    """Tone of the scene's first LED with a tone, by id. 1500 where not given."""
    step_hz: Annotated[float, Field(gt=0, le=MAX_TONE_HZ)] | None = None
    """Rise of the tone from one LED to the next; tones above 7000 Hz start at `first_hz` again. 200 where not given."""
    frequency_hz: Frequency | None = None
    """Frequency of a single LED's tone, in place of `first_hz` and `step_hz`; of pulse-width modulation, 1000 where not
    given; of the mains, 50 where not given: their light has twice it."""

    @model_validator(mode="after")
    def _keys_fit_the_wave(self) -> Self:
        allowed = KEYS_OF[self.send]
        for key in type(self).model_fields:
            if key != "send" and getattr(self, key) is not None and key not in allowed:
                has = ", ".join(allowed) or "no further key"
                raise key_error(key, f'is no key of send = "{self.send}", which has {has}')
        if self.frequency_hz is not None and (self.first_hz is not None or self.step_hz is not None):
            raise key_error("frequency_hz", "stands in place of first_hz and step_hz: remove it or them")
        return self

    @property
    def identifies(self) -> bool:
        """Whether the wave tells which LED it is."""
        return self.send in IDENTIFYING

    @property
    def chip_s(self) -> float:
        """Duration of a chip, seconds; codes and packets alone have chips."""
        return (DEFAULT_CHIP_US[self.send] if self.chip_us is None else self.chip_us) * 1e-6

    @property
    def chips(self) -> int:
        """Chips of a code."""
        return 32 if self.code_length is None else self.code_length

    @property
    def lit_share(self) -> float:
        """Lit share of the period: the duty; a half of codes and packets, which are balanced."""
        return 0.5 if self.duty is None else self.duty

    @property
    def modulation_depth(self) -> float:
        """Depth of modulation, 0 to 1."""
        return 1.0 if self.depth is None else self.depth

    @property
    def clock_sigma(self) -> float:
        """Standard deviation of the relative error of the clock's rate."""
        return 1e-4 if self.clock_error is None else self.clock_error

    @property
    def delayed(self) -> bool:
        """Whether packets of a panel's LEDs start one after another."""
        return self.delays != "common"

    @property
    def light_hz(self) -> float:
        """Frequency of light that is dimmed by pulse width, or that ripples with the mains."""
        given = DEFAULT_FREQUENCY_HZ[self.send] if self.frequency_hz is None else self.frequency_hz
        return 2 * given if self.send == "mains" else given

    def tone_hz(self, number: int) -> float:
        """Tone of an LED: `frequency_hz`, or that of LED `number` of the scene's LEDs with tones."""
        if self.frequency_hz is not None:
            return self.frequency_hz
        first = 1500.0 if self.first_hz is None else self.first_hz
        step = 200.0 if self.step_hz is None else self.step_hz
        count = int((MAX_TONE_HZ - first) / step * (1 + 1e-12)) + 1
        return first + step * (number % count)
