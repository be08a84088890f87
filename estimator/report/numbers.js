/* Numbers of the page, as estimator/report/numbers.py writes them: three digits, thin spaces, no exponents. */
"use strict";

const Numbers = (() => {
  const UNITS = { "µm": 1e-6, mm: 1e-3, m: 1 };
  const THIN = "\u202f";

  const grouped = (digits) => digits.replace(/\B(?=(\d{3})+(?!\d))/g, THIN);

  /** A number to three digits: 2.04, 34 600. */
  function three(value) {
    if (value === 0) return "0";
    const rounded = Number(value.toPrecision(3));
    const decade = Math.floor(Math.log10(Math.abs(rounded)) + 1e-12);
    if (decade >= 2) return grouped(rounded.toFixed(0));
    return rounded.toFixed(Math.min(2 - decade, 9));
  }

  /** A number with its sign, as three() has it. */
  const signed = (value) => (value < 0 ? "−" : "+") + three(Math.abs(value));

  /** A length in metres in its own unit: 2.04 µm. */
  function length(metres) {
    const size = Math.abs(Number(metres.toPrecision(3)));
    const unit = size >= 1 ? "m" : size >= 1e-3 ? "mm" : "µm";
    return `${three(metres / UNITS[unit])}\u00a0${unit}`;
  }

  /** Label of a place on an axis of lengths: 1 µm, 200 mm. */
  function tick(metres) {
    const unit = metres < 0.99e-3 ? "µm" : metres < 0.99 ? "mm" : "m";
    return `${grouped(String(Number((metres / UNITS[unit]).toPrecision(2))))}\u00a0${unit}`;
  }

  const sorted = (values) => values.filter((value) => value !== null).sort((a, b) => a - b);

  /** Number of sorted values that do not exceed a limit. */
  function below(values, limit) {
    let [low, high] = [0, values.length];
    while (low < high) {
      const middle = (low + high) >> 1;
      if (values[middle] <= limit) low = middle + 1;
      else high = middle;
    }
    return low;
  }

  /** Value of a share of sorted values, interpolated. */
  function quantile(values, share) {
    const place = (values.length - 1) * share;
    const first = Math.floor(place);
    const next = values[Math.min(first + 1, values.length - 1)];
    return values[first] + (next - values[first]) * (place - first);
  }

  const median = (values) => quantile(sorted(values), 0.5);
  const mean = (values) => values.reduce((sum, value) => sum + value, 0) / values.length;
  const spread = (values) => {
    const centre = mean(values);
    return Math.sqrt(mean(values.map((value) => (value - centre) ** 2)) * (values.length / Math.max(values.length - 1, 1)));
  };

  /** 95 % interval of a share of `count` of `of` (Wilson 1927). */
  function shareInterval(count, of) {
    const z = 1.96;
    const share = count / of;
    const half = z * Math.sqrt((share * (1 - share)) / of + (z * z) / (4 * of * of));
    const scale = 1 + (z * z) / of;
    return [(share + (z * z) / (2 * of) - half) / scale, (share + (z * z) / (2 * of) + half) / scale];
  }

  return { UNITS, three, signed, length, tick, sorted, below, quantile, median, mean, spread, shareInterval };
})();
