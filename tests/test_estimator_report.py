"""The page of scores: its figures are those of the scores, in the order and with the looks that names fix."""

import base64
import hashlib
import json
import math
import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from conftest import ROOT
from html_text import texts
from PIL import Image
from test_estimator_score import LEDS, LEDS_M, TRUTH, failed, ok, truths

from estimator.errors import InputError
from estimator.evaluate.entry import VariantEntry
from estimator.evaluate.frame_score import score_frame
from estimator.evaluate.score import Scores, VariantScore, score_variant
from estimator.methods.looks import look_of
from estimator.report import page_data
from estimator.report.answer import failure_rows, kind_of, lede, ordered, share_rows
from estimator.report.numbers import THIN, brief, length, page_unit, three
from estimator.report.page_data import script_json
from estimator.report.pictures import frames_first, pictures
from estimator.report.report import SCRIPTS, page

BOUND = (1e-6, 0.0, 0.0, 0.0, 1e-6, 0.0, 0.0, 0.0, 2e-6)
FIGURE = re.compile(r'<span class="n" data-m="([^"]+)"><i>([^<]*)</i><b>([^<]*)</b></span>')


def scored(
    errors_m: Sequence[float | None], name: str = "x", bound_m2: tuple[float, ...] | None = None
) -> VariantScore:
    x, y, z = TRUTH
    rows = [failed(k, "a: b") if e is None else ok(k, (x + e, y, z)) for k, e in enumerate(errors_m)]
    return score_variant(name, rows, truths(len(rows), bound_m2), LEDS_M)


def scores_of(variants: Sequence[VariantScore]) -> Scores:
    return Scores(dataset="set", room_m=(4.0, 5.0, 3.5), led_map=tuple(LEDS.values()), variants=tuple(variants))


def data_of(html: str) -> dict[str, object]:
    """The data of the page's first set."""
    (text, *_) = re.findall(r'<script type="application/json" class="data">(.*?)</script>', html, flags=re.DOTALL)
    found = json.loads(text)
    assert isinstance(found, dict)
    return found


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (0.0, "0"),
        (2.0416, "2.04"),
        (9.996, "10.0"),
        (99.96, "100"),
        (999.6, f"1{THIN}000"),
        (34591.0, f"34{THIN}600"),
        (-0.01234, "-0.0123"),
        (1e-12, "0.000000000"),
    ],
)
def test_numbers_have_three_digits(value: float, text: str) -> None:
    assert three(value) == text


def test_lengths_have_units() -> None:
    assert [length(size_m) for size_m in (2.04e-6, 9.996e-4, 0.9996, 34.6)] == [
        f"{number}\u00a0{unit}" for number, unit in (("2.04", "µm"), ("1.00", "mm"), ("1.00", "m"), ("34.6", "m"))
    ]
    assert [brief(value) for value in (20.0, 0.102, 100.0)] == ["20", "0.102", "100"]
    # The largest unit in which the smallest median is 1 or more.
    assert [page_unit(sizes) for sizes in ([0.5, 3e-3], [3e-6, 1.0], [2.0], [1e-9], [])] == ["mm", "µm", "m", "µm", "m"]


def test_variants_stand_by_median_then_p95_then_name() -> None:
    variants = [
        scored([0.2] * 4, "far"),
        scored([None] * 3 + [0.1], "failing"),
        scored([0.1, 0.1, 0.1, 0.9], "wide"),
        scored([0.1] * 4, "near-b"),
        scored([0.1] * 4, "near-a"),
    ]
    no_sensor = scored([None] * 4, "kim").model_copy(
        update={"entry": VariantEntry(look=look_of("kim"), inapplicable="needs two cameras")}
    )
    first, others = ordered(scores_of([*variants, no_sensor]))
    assert [one.variant for one in first] == ["near-a", "near-b", "wide", "far", "failing"]
    assert [one.variant for one in others] == ["kim"]
    found = texts(page([(Path("a"), scores_of([*variants, no_sensor]))]))
    assert "(needs two cameras)." in found


def test_figures_are_those_of_the_scores() -> None:
    """In the page's unit, to three digits: median and 95 % of all frames, largest error, shares, bound, NEES."""
    errors_m = [0.011 * k for k in range(1, 41)]
    one = scored(errors_m, "x", BOUND)
    html = page([(Path("a"), scores_of([one, scored([0.5, None] * 20, "y", BOUND)]))])
    assert one.of_all is not None
    assert one.error_3d is not None
    row = html[html.index('<tr role="row" data-variant="x"') :]
    cells = [(float(m), float(i + b)) for m, i, b in FIGURE.findall(row[: row.index("</tr>")])]
    expected_m = [one.of_all.median_m, one.of_all.p95_m, one.error_3d.max_m]
    assert [cell[0] for cell in cells] == expected_m
    for size_m, shown in cells:
        assert shown == float(three(size_m / 1e-3))  # the unit is mm: the smallest median is 220 mm
    assert one.ratio_to_bound is not None
    assert f">{three(one.ratio_to_bound.rms)}<small>" in row
    assert one.median_interval is not None
    assert f'data-lo="{one.median_interval.low_m}" data-hi="{one.median_interval.high_m}"' in row
    # Of 40 frames, 50, 90 and 99 % are the 20th, 36th and 40th error; of the other variant half failed.
    shares = {row.name: [cell.size_m for cell in row.sizes] for row in share_rows([one], scores_of([one]))}
    assert shares["x"] == pytest.approx([errors_m[19], errors_m[35], errors_m[39]])
    failing = scored([0.5, None] * 20, "y")
    (of_failing,) = share_rows([failing], scores_of([failing]))
    assert [cell.size_m for cell in of_failing.sizes] == [pytest.approx(0.5), math.inf, math.inf]


def test_errors_beyond_the_room_are_out_and_failed_frames_are_words() -> None:
    """The diagonal is 7.3 m: 7.2 m is a figure, 7.4 m is out, and no such error has a number in the page's unit."""
    html = page(
        [(Path("a"), scores_of([scored([7.2] * 3, "in"), scored([7.4] * 3, "beyond"), scored([None] * 3, "no")]))]
    )
    row = {
        name: html[(start := html.index(f'<tr role="row" data-variant="{name}"')) : html.index("</tr>", start)]
        for name in ("in", "beyond", "no")
    }
    assert len(FIGURE.findall(row["in"])) == 3
    assert not FIGURE.findall(row["beyond"])
    assert row["beyond"].count(">out</span>") == 3
    assert 'title="7.40\u00a0m, more than the room' in row["beyond"]
    assert row["no"].count(">failed</span>") == 2


def test_the_first_sentence_says_who_is_nearest_and_who_failed() -> None:
    variants = [scored([0.1] * 4, "a"), scored([0.102] * 4, "b"), scored([0.3] * 4, "c"), scored([9.0, None] * 2, "d")]
    scores = scores_of(variants)
    text = re.sub("<[^>]*>", "", lede(scores, ordered(scores)[0])).replace("\u00a0", " ")
    assert text == (
        "Nearest is a: half of the 4 frames within 100 mm, 95 % within 100 mm. As near: b. Next: c, 300 mm; last: d, "
        "beyond the room. Failed frames, of 4: 2 of d."
    )
    none = [scored([None, None, 0.1], "a")]
    assert "No variant answers half of the 3 frames" in lede(scores_of(none), none)


def test_reasons_that_differ_in_numbers_are_one() -> None:
    assert kind_of("identify: no spot within 15.5 px; 3 others") == "identify: no spot within N px"
    assert kind_of("variant: crashed (up2p)") == "variant: crashed (up2p)"
    rows = [failed(0, "a: 3 of 4"), failed(1, "a: 2 of 4"), failed(2, "b: x")]
    one = score_variant("x", rows, truths(3), LEDS_M)
    ((_, _, kinds),) = failure_rows([one])
    assert kinds == [("a: N of N", 2), ("b: x", 1)]


def test_odd_scores_make_a_page_too(tmp_path: Path) -> None:
    """No variant, no frame, all frames failed, one exact frame, a huge error."""
    for variants in (
        [],
        [scored([])],
        [scored([None])],
        [scored([0.0])],
        [scored([1e99, None]), scored([0.1, 0.1], "y")],
    ):
        html = page([(tmp_path, scores_of(variants))])
        body = re.sub(r"<script>.*?</script>", "", html, flags=re.DOTALL)
        assert not re.findall(r"\b(?:nan|inf|None|Infinity)\b", body)
        assert html.count("<table") == html.count("</table>")
        data_of(html)


def test_names_and_reasons_are_text_and_never_markup(tmp_path: Path) -> None:
    """Names of datasets and variants, and reasons, come from files: `<`, `&` and quotes are text."""
    hostile = """</script><script>"a"&'b'<!--"""
    variants = [
        score_variant(name, [failed(0, hostile), ok(1, TRUTH)], truths(2), LEDS_M)
        for name in (hostile, f"{hostile}:c,d")
    ]
    html = page([(tmp_path, scores_of(variants).model_copy(update={"dataset": hostile}))])
    # The page's own script elements, the data and the program, and nothing else.
    assert re.findall(r"<script[^>]*>", html) == ['<script type="application/json" class="data">', "<script>"]
    assert html.count("</script>") == 2
    assert "<!--" not in html
    assert data_of(html)["name"] == hostile
    assert f"Positioning report: {hostile}" in texts(html)
    assert ":<wbr>c,<wbr>d" in html  # lines may break before options


def test_json_in_a_script_element_cannot_end_it() -> None:
    text = script_json({"a": "</script><!-- & \u2028"})
    assert not set(text) & set("<>&")
    assert json.loads(text) == {"a": "</script><!-- & \u2028"}


def test_the_policy_allows_this_style_and_script_alone() -> None:
    html = page([(Path("a"), scores_of([scored([0.1])]))])
    (policy,) = re.findall(r'http-equiv="Content-Security-Policy" content="([^"]*)"', html)
    policy = policy.replace("&#39;", "'")
    for name, opening in (("style", "<style>"), ("script", "<script>")):
        (content,) = re.findall(f"{opening}(.*?)</{name}>", html, flags=re.DOTALL)
        digest = base64.b64encode(hashlib.sha256(content.encode()).digest()).decode()
        assert f"{name}-src 'sha256-{digest}'" in policy
    assert policy.startswith("default-src 'none'")
    assert "unsafe" not in policy
    # Nothing that the policy would forbid: no style attribute, no handler, no address.
    body = re.sub(r"<script>.*?</script>|<style>.*?</style>", "", html, flags=re.DOTALL)
    assert not re.findall(r"<[^>]*\s(?:style|on\w+|href)=", body)
    assert "http" not in body.replace("http-equiv", "")


def test_more_variants_than_six_show_the_best_of_each_family() -> None:
    names = ["ml", "gravity-fit", "up2p", "pnp", "ippe", "sqpnp", "huynh2016"]
    variants = [scored([0.01 * (k + 1)] * 2, name) for k, name in enumerate(names)]

    def shown(some: Sequence[VariantScore]) -> list[str]:
        data = page_data.page_data(Path("nowhere"), scores_of(some), some, None)
        return [one["name"] for one in data["variants"] if one["shown"]]

    assert shown(variants) == ["ml", "gravity-fit", "pnp", "huynh2016"]
    assert shown(variants[:6]) == names[:6]


def test_frames_that_a_reader_asks_for_come_first() -> None:
    """Worst, median and best of each variant: 4, 2, 0 and 0, 3; then the others in halving steps."""
    a, b = scored([0.1, 0.2, 0.3, 0.4, 0.5, None], "a"), scored([0.9, None, None, 0.1, None, None], "b")
    first = frames_first([a, b], 6)
    assert first[:4] == [4, 2, 0, 3]
    assert sorted(first) == list(range(6))


def test_pictures_end_with_their_budget(tmp_path: Path, rng: np.random.Generator) -> None:
    (tmp_path / "previews").mkdir()
    for k in range(3):
        noise = rng.integers(0, 255, (90, 120), dtype=np.uint8)
        Image.fromarray(noise).save(tmp_path / f"previews/{k:06}.png")
    every = pictures(tmp_path, [2, 0, 1, 7])
    assert list(every) == [2, 0, 1]
    assert {aspect for _, aspect in every.values()} == {120 / 90}
    sizes = [len(text) for text, _ in every.values()]
    assert list(pictures(tmp_path, [2, 0, 1], sizes[0] + sizes[1])) == [2, 0]
    assert list(pictures(tmp_path, [2, 0, 1], sizes[0] + sizes[1] - 1)) == [2]
    (tmp_path / "previews/000000.png").write_bytes(b"PNG")
    with pytest.raises(InputError, match=r"000000\.png: is no picture"):
        pictures(tmp_path, [0])


def many_frames(folder: Path, rng: np.random.Generator, variants: int = 3, count: int = 1000) -> Scores:
    """Scores of many frames in a room, with pictures of noise, which are large, for a tenth of them."""
    (folder / "previews").mkdir()
    for k in range(0, count, 10):
        Image.fromarray(rng.integers(0, 255, (300, 400), dtype=np.uint8)).save(folder / f"previews/{k:06}.png")
    truth = [
        row.model_copy(update={"position_m": tuple(rng.uniform(0.5, 3.5, 3).tolist())}) for row in truths(count, BOUND)
    ]
    names = ("tilt_deg", "distance_m", "snr")
    measures = [dict(zip(names, rng.uniform(1.0, 60.0, len(names)).tolist(), strict=True)) for _ in truth]
    found = rng.integers(4, 100, count).tolist()
    scores = []
    for k in range(variants):
        places = [np.array(row.position_m) + rng.normal(0, 0.01 * (k + 1), 3) for row in truth]
        rows = [ok(frame, tuple(place.tolist())) for frame, place in enumerate(places)]
        # The summaries are those of the first variant: their bootstraps take most of the time, and no picture has them.
        first = scores[0] if scores else score_variant("v0", rows, truth, LEDS_M)
        of_rows = tuple(
            replace(score_frame(row, true, LEDS_M), **measured, spots_found=spots)
            for row, true, measured, spots in zip(rows, truth, measures, found, strict=True)
        )
        scores.append(first.model_copy(update={"variant": f"v{k}", "rows": of_rows}))
    return scores_of(scores)


def test_the_page_shows_devices_and_levels_where_there_are_some() -> None:
    x, y, z = TRUTH
    rows = [ok(k, (x + 1e-3 * (k + 1), y, z)) for k in range(4)]
    several = scores_of([score_variant("x", rows, truths(4, BOUND), LEDS_M, [0, 1, 2, 2])])
    one = scores_of([scored([0.1, 0.2])])
    html = page([(Path("a"), several)])
    assert "By device and map" in html
    assert "By device and map" not in page([(Path("a"), one)])
    title = "Error against the bound, set by set"
    assert title not in html
    assert title in page([(Path("a"), several), (Path("b"), several)])
    assert title not in page([(Path("a"), several), (Path("b"), one)])


def test_the_scripts_and_styles_load_nothing() -> None:
    for name in (*SCRIPTS, "report.css", "report.html"):
        text = (ROOT / "estimator/report" / name).read_text()
        assert not re.findall(r"https?://(?!www\.w3\.org/2000/svg)", text), name
        assert "innerHTML" not in text, name
        assert "eval(" not in text, name
