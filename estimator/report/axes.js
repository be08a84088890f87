/* Elements, axes and marks that the pictures share. */
/* global Numbers */
/* exported Axes */

const Axes = (() => {
  const SVG = "http://www.w3.org/2000/svg";

  function build(node, attributes, children) {
    for (const [name, value] of Object.entries(attributes || {})) {
      if (value !== null && value !== undefined && value !== false) node.setAttribute(name, value === true ? "" : value);
    }
    node.append(...children.filter((child) => child !== null && child !== undefined));
    return node;
  }
  /** SVG element; children are elements or text. */
  const svg = (name, attributes, ...children) => build(document.createElementNS(SVG, name), attributes, children);
  /** HTML element; children are elements or text. */
  const html = (name, attributes, ...children) => build(document.createElement(name), attributes, children);

  /** Picture of a width and height in pixels, in place of what a box holds. */
  function picture(box, width, height, label, children, attributes) {
    const root = svg("svg", { width, height, viewBox: `0 0 ${width} ${height}`, role: "img", "aria-label": label, ...attributes }, ...children);
    box.replaceChildren(root);
    return root;
  }

  const fixed = (value) => value.toFixed(1);
  const line = (kind, x1, y1, x2, y2) => svg("line", { class: kind, x1: fixed(x1), y1: fixed(y1), x2: fixed(x2), y2: fixed(y2) });
  const text = (x, y, anchor, words, kind) => svg("text", { x: fixed(x), y: fixed(y), "text-anchor": anchor, class: kind }, words);

  /** Path of a mark of a radius. */
  const markPath = (shape, x, y, radius) => `M${shape.map(([a, b]) => `${fixed(x + a * radius)} ${fixed(y + b * radius)}`).join("L")}z`;

  /** Name of a variant, whose line may break before its options. */
  function named(name) {
    const parts = name.split(/(?<=[:,])/).flatMap((part) => [html("wbr"), part]);
    return html("span", null, ...parts.slice(1));
  }

  /** Mark of a variant before its name. */
  const key = (variant, shapes) =>
    svg("svg", { class: `key ${variant.look}`, viewBox: "0 0 13 13", "aria-hidden": "true" }, svg("path", { class: "mark", d: markPath(shapes[variant.mark], 6.5, 6.5, 4.6) }));

  /** Logarithmic or linear axis from `low` to `high`, drawn from `start` to `end` pixels. */
  function axis(low, high, start, end, logarithmic) {
    const share = logarithmic
      ? (value) => Math.log(value / low) / Math.log(high / low)
      : (value) => (value - low) / (high - low);
    const place = (value) => start + (end - start) * share(value);
    const value = (pixel) => {
      const part = (pixel - start) / (end - start);
      return logarithmic ? low * (high / low) ** part : low + (high - low) * part;
    };
    return { low, high, place, value, logarithmic };
  }

  /** Decades between two values, also 2 and 5 times where there are few; at most `most`. */
  function decades(low, high, most) {
    const found = [];
    const first = Math.floor(Math.log10(low));
    for (const digits of [[1], [1, 2, 5]]) {
      found.length = 0;
      for (let decade = first; decade <= Math.log10(high) + 1; decade += 1) {
        for (const digit of digits) {
          const value = digit * 10 ** decade;
          if (value >= low * 0.999 && value <= high * 1.001) found.push(value);
        }
      }
      if (found.length >= 2) break;
    }
    const step = Math.ceil(found.length / most);
    return found.filter((_, index) => index % step === 0);
  }

  /** Round values between two others, at most `most`. */
  function steps(low, high, most) {
    const smallest = (high - low) / most;
    if (!(smallest > 0)) return [low];
    const decade = 10 ** Math.floor(Math.log10(smallest));
    const step = [1, 2, 5, 10].map((digit) => digit * decade).find((one) => one >= smallest * 0.999);
    const found = [];
    for (let index = Math.ceil(low / step - 1e-9); index * step <= high + 1e-9 * step; index += 1) found.push(index * step);
    return found;
  }

  const plain = (value) => String(Number(value.toPrecision(6)));

  /** Limits of an axis of errors that holds sorted lists, up to `most`, with some room. */
  function limits(lists, most) {
    const ends = lists.flatMap((list) => [list[0], list[list.length - 1]]).filter((value) => value > 0);
    if (!ends.length) return [1e-6, 1];
    const low = Math.min(...ends) * 0.8;
    const high = Math.min(Math.max(...ends) * 1.25, most * 1.15);
    return high > low * 3 ? [low, high] : [low / 2, Math.max(high, low) * 2];
  }

  /** Drawing on a canvas below the picture of a box, sharp on any screen. */
  function canvas(box, width, height) {
    const found = html("canvas", { "aria-hidden": "true" });
    const scale = Math.max(window.devicePixelRatio || 1, 2);
    [found.width, found.height] = [width * scale, height * scale];
    [found.style.width, found.style.height] = [`${width}px`, `${height}px`];
    box.prepend(found);
    const pen = found.getContext("2d");
    pen.setTransform(scale, 0, 0, scale, 0, 0);
    return pen;
  }

  /** Hue of a variant as the style sheet has it now. */
  function hue(box, variant) {
    const probe = html("span", { class: variant.look });
    box.append(probe);
    const found = getComputedStyle(probe).getPropertyValue("--hue").trim();
    probe.remove();
    // A custom property that names another one comes resolved.
    return found;
  }

  /** Draw a mark on a canvas. */
  function drawMark(pen, shape, x, y, radius, colour, hollow) {
    pen.beginPath();
    for (const [a, b] of shape) pen.lineTo(x + a * radius, y + b * radius);
    pen.closePath();
    if (hollow) {
      pen.strokeStyle = colour;
      pen.lineWidth = 1.2;
      pen.stroke();
    } else {
      pen.fillStyle = colour;
      pen.fill();
    }
  }

  return { svg, html, picture, line, text, markPath, named, key, axis, decades, steps, plain, limits, canvas, hue, drawMark, fixed };
})();
