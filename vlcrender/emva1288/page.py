"""HTML page of a data sheet with its plots: one file, no network. page.html beside this module is its template."""

from collections.abc import Callable, Sequence
from html import escape

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup
from numpy.typing import NDArray

from vlcrender.emva1288.datasheet import Datasheet, cells
from vlcrender.sensor.sensor import Sensor

Array = NDArray[np.float64]
WIDTH, HEIGHT = 960.0, 380.0
LEFT, RIGHT, TOP, BOTTOM = 76.0, 28.0, 12.0, 44.0

TEMPLATES = Environment(
    loader=PackageLoader("vlcrender.emva1288", "."),
    autoescape=True,
    undefined=StrictUndefined,
    trim_blocks=True,
    lstrip_blocks=True,
    keep_trailing_newline=True,
)


def page(sheet: Datasheet) -> str:
    """The HTML text of the page."""
    return TEMPLATES.get_template("page.html").render(
        sheet=sheet,
        rows=[(row, *cells(row)) for row in sheet.rows],
        photon_transfer=Markup(_photon_transfer(sheet)),
        signal_to_noise=Markup(_signal_to_noise(sheet)),
    )


def _photon_transfer(sheet: Datasheet) -> str:
    measured = sheet.measurement
    signals = measured.signals_dn
    variances = np.array([p.variance_dn2 for p in measured.points]) - measured.dark.variance_dn2
    gain = 1 / sheet.sensor.gain_at_iso_e_per_dn
    across, up = float(signals.max()) * 1.03, max(float(variances.max()), gain * float(signals.max())) * 1.05

    def place(x: Array, y: Array) -> tuple[Array, Array]:
        return LEFT + x / across * (WIDTH - LEFT - RIGHT), HEIGHT - BOTTOM - y / up * (HEIGHT - TOP - BOTTOM)

    full = float(signals[measured.saturation_index])
    ends = np.array([0.0, float(signals.max())])
    parts = [
        *_axes(_steps(across), _steps(up), place, "mean, DN", "variance, DN²"),
        _path(*place(ends, gain * ends), "set"),
        _path(*place(np.array([full, full]), np.array([0.0, up])), "limit"),
        *_dots(*place(signals, variances)),
    ]
    return _svg("photon transfer curve", parts)


def _signal_to_noise(sheet: Datasheet) -> str:
    measured, sensor = sheet.measurement, sheet.sensor
    dark_dn = measured.dark.mean_dn
    points = [
        p
        for p in (*measured.faint, *measured.points[: measured.saturation_index + 1])
        if p.variance_dn2 > 0 and p.mean_dn - dark_dn > 0.1 * p.variance_dn2**0.5
    ]
    photons = np.array([p.photons for p in points])
    ratios = np.array([(p.mean_dn - dark_dn) / p.variance_dn2**0.5 for p in points])
    top = float(np.ceil(np.log10(photons[-1])))
    curve = np.logspace(0, np.log10(photons[-1]), 200)
    high = float(np.ceil(np.log10(np.sqrt(photons[-1]))))

    def place(x: Array, y: Array) -> tuple[Array, Array]:
        u, v = np.log10(x) / top, (np.log10(y) + 1) / (high + 1)
        return LEFT + u * (WIDTH - LEFT - RIGHT), HEIGHT - BOTTOM - v * (HEIGHT - TOP - BOTTOM)

    decades_x, decades_y = np.logspace(0, top, int(top) + 1), np.logspace(-1, high, int(high) + 2)
    set_ratios = _signal_to_noise_of(sensor, curve * sheet.efficiency)
    shown = set_ratios >= 0.1
    parts = [
        *_axes(decades_x, decades_y, place, "photons per pixel", "signal to noise"),
        _path(*place(curve, np.sqrt(curve)), "limit"),
        _path(*place(curve[shown], set_ratios[shown]), "set"),
        *_dots(*place(photons, ratios)),
    ]
    return _svg("signal to noise ratio", parts)


def _signal_to_noise_of(sensor: Sensor, electrons: Array) -> Array:
    """Signal to noise of mean electrons by the sensor's settings, by temporal noise alone, as EMVA 1288 counts it."""
    acting, gain = sensor.acting(), sensor.gain_at_iso_e_per_dn
    dark_e2 = acting["read_noise_e"] ** 2 + (acting["adc_noise_dn"] ** 2 + 1 / 12) * gain**2
    return np.asarray(electrons / np.sqrt(electrons + dark_e2))


def _steps(end: float) -> Array:
    """Five to ten round numbers from 0 to `end`."""
    power = 10.0 ** np.floor(np.log10(end / 5))
    step = power * max(factor for factor in (1, 2, 5) if factor * power <= end / 5)
    return np.arange(0.0, end, step)


def _axes(
    xs: Array, ys: Array, place: Callable[[Array, Array], tuple[Array, Array]], x_name: str, y_name: str
) -> list[str]:
    """Grid lines and numbers at the values `xs` and `ys`; both start at the origin of the plot."""
    parts = []
    across, floor = place(xs, np.full(len(xs), ys[0]))
    for u, v, value in zip(across, floor, xs, strict=True):
        parts.append(f'<line class="rule" x1="{u:.1f}" y1="{TOP}" x2="{u:.1f}" y2="{v:.1f}"/>')
        parts.append(f'<text x="{u:.1f}" y="{v + 17:.1f}" text-anchor="middle">{value:,.6g}</text>')
    left, up = place(np.full(len(ys), xs[0]), ys)
    for u, v, value in zip(left, up, ys, strict=True):
        parts.append(f'<line class="rule" x1="{u:.1f}" y1="{v:.1f}" x2="{WIDTH - RIGHT}" y2="{v:.1f}"/>')
        parts.append(f'<text x="{u - 8:.1f}" y="{v + 4:.1f}" text-anchor="end">{value:,.6g}</text>')
    middle = (HEIGHT - BOTTOM + TOP) / 2
    parts.append(f'<text x="{WIDTH / 2}" y="{HEIGHT - 8}" text-anchor="middle">{escape(x_name)}</text>')
    parts.append(f'<text transform="translate(14 {middle}) rotate(-90)" text-anchor="middle">{escape(y_name)}</text>')
    return parts


def _path(x: Array, y: Array, kind: str) -> str:
    places = " ".join(f"{u:.1f},{v:.1f}" for u, v in zip(x, y, strict=True))
    return f'<path class="{kind}" d="M{places}"/>'


def _dots(x: Array, y: Array) -> list[str]:
    return [f'<circle class="measured" cx="{u:.1f}" cy="{v:.1f}" r="3"/>' for u, v in zip(x, y, strict=True)]


def _svg(label: str, parts: Sequence[str]) -> str:
    body = "\n".join(parts)
    return f'<svg viewBox="0 0 {WIDTH:.0f} {HEIGHT:.0f}" role="img" aria-label="{escape(label)}">\n{body}\n</svg>'
