/* Pictures of one set: strips of the table, curves, plans, what the error depends on. Each draws into a box anew. */
/* global Numbers, Axes */
/* exported Pictures */

const Pictures = (() => {
  const { svg, line, text, axis, fixed } = Axes;

  /** Strip of a variant in the table: a tick for each frame, the middle 90 %, the median. */
  function strip(box, set, variant, range) {
    const width = Math.max(box.clientWidth, 60);
    const across = axis(...range, 8, width - 8, true);
    const inside = variant.sorted.filter((error) => error >= range[0] && error <= range[1]);
    const parts = Axes.decades(...range, 8).map((value) => line("rule", across.place(value), 0, across.place(value), 34));
    if (set.bound) {
      const place = across.place(set.bound[50]);
      if (place > 0 && place < width) parts.push(line("bound", place, 1, place, 34));
    }
    parts.push(svg("path", { class: "ticks", d: inside.map((error) => `M${fixed(across.place(error))} 9v16`).join("") || "M0 0" }));
    if (variant.sorted.length) {
      const at = (share) => Math.min(Math.max(across.place(Math.max(Numbers.quantile(variant.sorted, share), range[0])), 4), width - 4);
      if (variant.sorted.length > 4) parts.push(line("whisker", at(0.05), 17, at(0.95), 17));
      parts.push(svg("path", { class: `mark${variant.hollow ? " hollow" : ""}`, d: Axes.markPath(set.shapes[variant.mark], at(0.5), 17, 5) }));
    }
    box.replaceChildren(svg("svg", { class: variant.look, viewBox: `0 0 ${width} 34`, height: 34 }, ...parts));
  }

  /** Axis above the strips. */
  function stripHead(box, range) {
    const width = Math.max(box.clientWidth, 60);
    const across = axis(...range, 8, width - 8, true);
    const labels = Axes.decades(...range, Math.max(2, Math.floor(width / 62))).map((value) => text(across.place(value), 12, "middle", Numbers.tick(value)));
    box.replaceChildren(svg("svg", { viewBox: `0 0 ${width} 16`, height: 16 }, ...labels));
  }

  /** Places of labels of curves: where they cover least; curves that coincide share one. */
  function curveLabels(set, shown, across, up, right) {
    const nth = (values, share) => values[Math.min(values.length - 1, Math.max(0, Math.ceil(share * set.count) - 1))];
    const groups = [];
    const dots = [];
    for (const variant of shown) {
      if (variant.sorted.length < set.count / 2) continue;
      const middle = nth(variant.sorted, 0.5);
      if (middle < across.low || middle > across.high) continue;
      const same = groups.find((group) => Math.abs(Math.log(group.middle / middle)) < 0.03);
      if (same) same.variants.push(variant);
      else groups.push({ middle, variants: [variant], at: (share) => nth(variant.sorted, share) });
      const most = variant.sorted.length / set.count;
      for (let share = 0.02; share < most; share += 0.02) dots.push([across.place(nth(variant.sorted, share)), up.place(share)]);
    }
    if (set.bound) {
      groups.push({ middle: set.bound[50], variants: [], at: (share) => set.bound[Math.round(100 * share)] });
      for (let share = 0.04; share < 1; share += 0.04) dots.push([across.place(set.bound[Math.round(100 * share)]), up.place(share)]);
    }
    const taken = [];
    return groups.map((group) => {
      const words = group.variants.map((variant) => variant.name).join(" = ") || "at the bound";
      const wide = 7.6 * words.length + 6;
      let best = null;
      for (const share of [0.5, 0.6, 0.4, 0.7, 0.3, 0.8, 0.2, 0.12, 0.88]) {
        for (const side of [1, -1]) {
          const [x, y] = [across.place(group.at(share)), up.place(share)];
          const [from, to] = side > 0 ? [x + 9, x + 9 + wide] : [x - 9 - wide, x - 9];
          const hidden = dots.filter(([u, v]) => u > from - 2 && u < to + 2 && Math.abs(v - y) < 10).length;
          const crowded = taken.filter((one) => one.from < to && one.to > from && Math.abs(one.y - y) < 20).length;
          const outside = from < 46 || to > right ? 99 : 0;
          const cost = 3 * Math.abs(share - 0.5) + (side < 0 ? 0.2 : 0) + outside + 9 * crowded + hidden;
          if (!best || cost < best.cost) best = { cost, x, y, side, from: from - 14, to: to + 14, words, variants: group.variants };
        }
      }
      taken.push(best);
      return best;
    });
  }

  /** Cumulative distributions over all frames; returns the picture and its axis of errors. */
  function curves(box, set, shown, range, cursor) {
    const width = box.clientWidth;
    const small = width < 500;
    const height = small ? 280 : 380;
    const [left, right, top, bottom] = [44, width - 14, 12, height - 40];
    const across = axis(...range, left, right, true);
    const up = axis(0, 1, bottom, top, false);
    const parts = [];
    for (const share of [0, 0.25, 0.5, 0.75, 0.95, 1]) {
      parts.push(line("rule", left, up.place(share), right, up.place(share)));
      parts.push(text(left - 6, up.place(share) + (share === 0.95 ? 9 : share === 1 ? 2 : 4), "end", `${100 * share}${share === 1 ? "\u2009%" : ""}`));
    }
    for (const value of Axes.decades(...range, small ? 5 : 12)) {
      parts.push(line("rule", across.place(value), top, across.place(value), bottom));
      parts.push(text(across.place(value), bottom + 16, "middle", Numbers.tick(value)));
    }
    parts.push(text((left + right) / 2, height - 6, "middle", small ? "3D error" : "3D error, logarithmic; a failed frame counts as infinite error"));
    const clip = `clip-${set.id}`;
    parts.push(svg("clipPath", { id: clip }, svg("rect", { x: left, y: top - 4, width: Math.max(right - left, 1), height: bottom - top + 8 })));
    const inside = svg("g", { "clip-path": `url(#${clip})` });
    const grid = Array.from({ length: 121 }, (_, index) => range[0] * (range[1] / range[0]) ** (index / 120));
    for (const variant of shown.filter((one) => one.sorted.length)) {
      const reached = grid.filter((value) => value >= variant.sorted[0] * 0.97 && value <= variant.sorted[variant.sorted.length - 1] * 1.03);
      const limits = reached.map((value) => [value, ...Numbers.shareInterval(Numbers.below(variant.sorted, value), set.count)]);
      const upper = limits.map(([value, , high]) => `${fixed(across.place(value))} ${fixed(up.place(high))}`);
      const lower = limits.map(([value, low]) => `${fixed(across.place(value))} ${fixed(up.place(low))}`).reverse();
      if (limits.length > 1) inside.append(svg("g", { class: variant.look }, svg("path", { class: "band", d: `M${[...upper, ...lower].join("L")}z` })));
    }
    if (set.bound) {
      const places = set.bound.map((size, index) => `${fixed(across.place(size))} ${fixed(up.place(Math.min(Math.max(index / 100, 0.001), 0.999)))}`);
      inside.append(svg("path", { class: "bound", d: `M${places.join("L")}` }));
    }
    for (const variant of shown) {
      let path = `M${left} ${fixed(up.place(Numbers.below(variant.sorted, range[0]) / set.count))}`;
      variant.sorted.forEach((error, index) => {
        if (error >= range[0] && error <= range[1]) path += `H${fixed(across.place(error))}V${fixed(up.place((index + 1) / set.count))}`;
      });
      inside.append(svg("g", { class: variant.look }, svg("path", { class: `curve${variant.hollow ? " hollow" : ""}`, d: `${path}H${right}`, "data-variant": variant.name })));
    }
    parts.push(inside);
    for (const label of curveLabels(set, shown, across, up, right)) {
      label.variants.forEach((variant, index) => {
        const y = label.y + 13 * (index - (label.variants.length - 1) / 2);
        parts.push(svg("g", { class: variant.look }, svg("path", { class: `mark${variant.hollow ? " hollow" : ""}`, d: Axes.markPath(set.shapes[variant.mark], label.x, y, 5) })));
      });
      parts.push(text(label.x + 11 * label.side, label.y + 4, label.side > 0 ? "start" : "end", label.words, `lab${label.variants.length ? "" : " bound"}`));
    }
    const cross = line("axis dashed cursor", 0, top, 0, bottom);
    parts.push(cross, svg("rect", { class: "drag", x: 0, y: top, width: 0, height: bottom - top }));
    moveCursor(cross, across, cursor);
    const label = "Cumulative distribution of the 3D error; its figures are in the table of the curves";
    return { root: Axes.picture(box, width, height, label, parts, { tabindex: "0" }), across, cross };
  }

  /** Put the cursor of the curves at an error, or away where it is null. */
  function moveCursor(cross, across, cursor) {
    const place = cursor === null ? -10 : across.place(cursor);
    cross.setAttribute("x1", fixed(place));
    cross.setAttribute("x2", fixed(place));
  }

  /** Factor, 1, 2 or 5 times a power of ten, that makes an error of `size` about `wanted` long. */
  function exaggeration(size, wanted) {
    const decade = 10 ** Math.floor(Math.log10(wanted / size));
    return [5, 2, 1].map((digit) => digit * decade).find((factor) => factor <= wanted / size) || decade;
  }

  /** Factor of a variant's arrows: nine of ten are no longer than a tenth of the room. */
  function arrowFactor(set, variant) {
    if (!variant.sorted.length) return 1;
    return Math.max(exaggeration(Numbers.quantile(variant.sorted, 0.9) || 1e-9, Math.max(...set.room) / 10), 1);
  }

  /** The room with true positions and a variant's errors as arrows; axes 0, 1, 2 are x, y, z. */
  function plan(box, set, variant, axes, chosen, onChoose) {
    const width = box.clientWidth;
    const [a, b] = axes;
    const [left, right, top] = [28, width - 10, 8];
    const scale = (right - left) / set.room[a];
    const height = set.room[b] * scale + top + 34;
    const place = (point) => [left + point[a] * scale, top + (set.room[b] - point[b]) * scale];
    const factor = arrowFactor(set, variant);
    const parts = [svg("rect", { class: "wall", x: left, y: top, width: fixed(right - left), height: fixed(set.room[b] * scale) })];
    for (const value of Axes.steps(0, set.room[a], width < 420 ? 5 : 9)) parts.push(text(left + value * scale, top + set.room[b] * scale + 15, "middle", Axes.plain(value)));
    for (const value of Axes.steps(0, set.room[b], Math.max(2, Math.min(9, (set.room[b] * scale) / 30)))) parts.push(text(left - 6, top + (set.room[b] - value) * scale + 4, "end", Axes.plain(value)));
    parts.push(text(right, top + set.room[b] * scale + 29, "end", `${"xyz"[a]}, m`));
    const lamps = set.leds.map((led) => place(led.slice(1, 4)));
    parts.push(svg("path", { class: "led", d: lamps.map(([x, y]) => `M${fixed(x - 1)} ${fixed(y - 1)}h2v2h-2z`).join("") || "M0 0" }));
    const tips = svg("g", { class: variant.look });
    let arrows = "";
    variant.errors.forEach((error, frame) => {
      if (!Array.isArray(error)) return;
      const [x, y] = place(set.frames.true[frame]);
      const reach = (value) => Math.max(-1e4, Math.min(1e4, value * factor * scale));
      const [du, dv] = [reach(error[a]), -reach(error[b])];
      arrows += `M${fixed(x)} ${fixed(y)}l${fixed(du)} ${fixed(dv)}`;
      const long = Math.hypot(du, dv);
      if (long > 5) {
        const [eu, ev] = [(du / long) * 4, (dv / long) * 4];
        arrows += `m${fixed(-eu - ev / 2)} ${fixed(-ev + eu / 2)}L${fixed(x + du)} ${fixed(y + dv)}l${fixed(-eu + ev / 2)} ${fixed(-ev - eu / 2)}`;
      }
    });
    tips.append(svg("path", { class: "arrow", d: arrows || "M0 0" }));
    const room = svg("svg", { x: left, y: top, width: Math.max(right - left, 1), height: set.room[b] * scale, viewBox: `${left} ${top} ${Math.max(right - left, 1)} ${set.room[b] * scale}` }, tips);
    parts.push(room);
    const points = set.frames.true.map(place);
    parts.push(svg("path", { class: "truth", d: points.map(([x, y]) => `M${fixed(x - 2)} ${fixed(y)}a2 2 0 1 0 4 0a2 2 0 1 0 -4 0`).join("") }));
    if (points[chosen]) parts.push(svg("circle", { class: "chosen", cx: fixed(points[chosen][0]), cy: fixed(points[chosen][1]), r: 7 }));
    const root = Axes.picture(box, width, height, b === 1 ? "The room from above" : "The room from the side", parts);
    root.addEventListener("click", (event) => onChoose(nearest(points, event, root, 14)));
    return { factor, scale };
  }

  /** Arrow of a round length beside what it stands for: an error of this many metres at a factor and a scale in pixels. */
  function scaleKey(variant, factor, scale) {
    const metres = exaggeration(1, 60 / (factor * scale));
    const long = metres * factor * scale;
    const arrow = svg("path", { class: "arrow", d: `M1 1v8M1 5h${fixed(long)}l-4 -2m4 2l-4 2` });
    return [svg("svg", { class: `scale-key ${variant.look}`, width: fixed(long + 3), height: 10, "aria-hidden": "true" }, arrow), ` = ${Numbers.tick(metres)} of error. `];
  }

  /** Index of the point nearest to an event, null beyond `most` pixels. */
  function nearest(points, event, root, most) {
    const frame = root.getBoundingClientRect();
    let [best, found] = [most, null];
    points.forEach((point, index) => {
      if (!point) return;
      const distance = Math.hypot(point[0] - (event.clientX - frame.left), point[1] - (event.clientY - frame.top));
      if (distance < best) [best, found] = [distance, index];
    });
    return found;
  }

  /** Errors of the shown variants against a value of the frames */
  function scatter(box, set, shown, title, values, range, chosen, onChoose) {
    const known = values.filter((value) => value !== null);
    const [low, high] = [Math.min(...known), Math.max(...known)];
    const width = box.clientWidth;
    const [left, right, top, bottom, height] = [58, width - 8, 6, 190, 226];
    const wide = high - low;
    const logarithmic = low > 0 && high / low > 20;
    const ends = logarithmic ? [low / 1.08, high * 1.08] : [low - 0.04 * wide, high + 0.04 * wide];
    const across = axis(...ends, left, right, logarithmic);
    const up = axis(...range, bottom, top, true);
    const parts = [svg("rect", { class: "wall", x: left, y: top, width: right - left, height: bottom - top })];
    for (const value of Axes.decades(...range, 6)) {
      parts.push(line("rule", left, up.place(value), right, up.place(value)));
      parts.push(text(left - 5, up.place(value) + 4, "end", Numbers.tick(value)));
    }
    const marks = logarithmic ? Axes.decades(...ends, 5) : Axes.steps(...ends, 5);
    for (const value of marks) parts.push(text(across.place(value), bottom + 15, "middle", Axes.plain(value)));
    parts.push(text((left + right) / 2, height - 4, "middle", title));
    const points = [];
    const pen = { marks: [] };
    for (const variant of shown) {
      const pairs = [];
      variant.sizes.forEach((error, frame) => {
        if (error === null || values[frame] === null) return;
        const size = Math.min(Math.max(error, range[0]), range[1]);
        const point = [across.place(values[frame]), up.place(size)];
        pen.marks.push([variant, point, frame]);
        pairs.push([values[frame], size]);
        points.push([...point, frame]);
      });
      const medians = binMedians(pairs);
      if (medians.length > 1) {
        const path = medians.map(([value, error]) => `${fixed(across.place(value))} ${fixed(up.place(error))}`).join("L");
        parts.push(svg("g", { class: variant.look }, svg("path", { class: `curve${variant.hollow ? " hollow" : ""}`, d: `M${path}` })));
      }
    }
    const root = Axes.picture(box, width, height, `3D error against ${title}`, parts);
    const brush = Axes.canvas(box, width, height);
    brush.globalAlpha = pen.marks.length > 400 ? 0.4 : 0.65;
    const hues = new Map(shown.map((variant) => [variant, Axes.hue(box, variant)]));
    for (const [variant, [x, y]] of pen.marks) Axes.drawMark(brush, set.shapes[variant.mark], x, y, 2.2, hues.get(variant), variant.hollow);
    for (const [variant, [x, y], frame] of pen.marks) {
      if (frame === chosen) root.append(svg("g", { class: variant.look }, svg("path", { class: `mark picked${variant.hollow ? " hollow" : ""}`, d: Axes.markPath(set.shapes[variant.mark], x, y, 4.5) })));
    }
    root.addEventListener("click", (event) => {
      const found = nearest(points, event, root, 12);
      onChoose(found === null ? null : points[found][2]);
    });
  }

  /** Medians of bins that hold equally many pairs (value, error), eight bins or fewer. */
  function binMedians(pairs) {
    const ordered = [...pairs].sort((p, q) => p[0] - q[0]);
    const bins = Math.min(8, Math.floor(ordered.length / 5));
    return Array.from({ length: bins }, (_, bin) => {
      const some = ordered.slice(Math.floor((bin * ordered.length) / bins), Math.floor(((bin + 1) * ordered.length) / bins));
      return [Numbers.median(some.map((pair) => pair[0])), Numbers.median(some.map((pair) => pair[1]))];
    });
  }

  /** Errors of all frames in an order. */
  function timeline(box, set, shown, order, range, place, onChoose) {
    const width = box.clientWidth;
    const [left, right, top, bottom, height] = [58, width - 8, 6, 84, 92];
    const up = axis(...range, bottom, top, true);
    const x = (index) => left + ((right - left) * (index + 0.5)) / Math.max(order.length, 1);
    const parts = Axes.decades(...range, 4).flatMap((value) => [
      line("rule", left, up.place(value), right, up.place(value)),
      text(left - 5, up.place(value) + 4, "end", Numbers.tick(value)),
    ]);
    parts.push(line("axis", x(place), top, x(place), bottom));
    const root = Axes.picture(box, width, height, "3D error of each frame in the chosen order", parts);
    const pen = Axes.canvas(box, width, height);
    const radius = order.length > 300 ? 1.2 : 2;
    for (const variant of shown) {
      const hue = Axes.hue(box, variant);
      order.forEach((frame, index) => {
        const error = variant.sizes[frame];
        if (error !== null) Axes.drawMark(pen, set.shapes[variant.mark], x(index), up.place(Math.min(Math.max(error, range[0]), range[1])), radius, hue, variant.hollow);
      });
    }
    root.addEventListener("click", (event) => {
      const share = (event.clientX - root.getBoundingClientRect().left - left) / (right - left);
      onChoose(Math.min(Math.max(Math.floor(share * order.length), 0), order.length - 1));
    });
  }

  /** Offsets of spots from the images of the LEDs' centres, pixels, with a ring of a round size. */
  function target(box, offsets) {
    const size = 150;
    const largest = Math.max(...offsets.map(([u, v]) => Math.hypot(u, v)), 0.01);
    const decade = 10 ** Math.floor(Math.log10(largest));
    const ring = [1, 2, 5, 10].map((digit) => digit * decade).find((radius) => radius >= largest * 0.999);
    const at = (value) => size / 2 + (value / ring) * 60;
    const parts = [
      svg("circle", { class: "rule", cx: 75, cy: 75, r: 60 }),
      line("rule", 10, 75, 140, 75),
      line("rule", 75, 10, 75, 140),
      ...offsets.map(([u, v]) => svg("circle", { class: "offset", cx: fixed(at(u)), cy: fixed(at(v)), r: 2 })),
      text(75, 145, "middle", `ring: ${Axes.plain(ring)} px`),
    ];
    Axes.picture(box, size, size, `Offsets of ${offsets.length} spots, within a ring of ${Axes.plain(ring)} pixels`, parts);
  }

  return { strip, stripHead, curves, moveCursor, plan, scaleKey, scatter, timeline, target };
})();
