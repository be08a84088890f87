/* The page's state: unit, variants shown, chosen frame; the frame with its LEDs; tabs of several sets. */
/* global Numbers, Axes, Pictures */

(() => {
  const { svg, html } = Axes;
  const one = (selector, root) => root.querySelector(selector);
  const all = (selector, root) => [...root.querySelectorAll(selector)];

  /** Pixel of a point in camera axes by a camera of the set; null where it has none. */
  function pixel(camera, [x, y, z]) {
    let a;
    let b;
    if (camera.fisheye) {
      const rho = Math.hypot(x, y);
      const angle = rho > 0 ? Math.atan2(rho, z) / rho : 1 / z;
      [a, b] = [x * angle, y * angle];
    } else {
      if (z <= 0) return null;
      [a, b] = [x / z, y / z];
      if (camera.lens) {
        const [k1, k2, k3, p1, p2] = camera.lens;
        const r2 = a * a + b * b;
        if (camera.fold && r2 >= camera.fold) return null;
        const s = 1 + r2 * (k1 + r2 * (k2 + r2 * k3));
        [a, b] = [a * s + 2 * p1 * a * b + p2 * (r2 + 2 * a * a), b * s + p1 * (r2 + 2 * b * b) + 2 * p2 * a * b];
      }
    }
    const [[fx, skew, cx], [, fy, cy]] = camera.K;
    return [fx * a + skew * b + cx, fy * b + cy];
  }

  /** Squared radius at which the image of a lens first folds, infinity if nowhere; nothing beyond it has a pixel. */
  function foldOf([k1, k2, k3]) {
    for (let r = 0; r < 20; r += 0.005) {
      const r2 = r * r;
      if (1 + r2 * (3 * k1 + r2 * (5 * k2 + r2 * 7 * k3)) <= 0) return r2;
    }
    return Infinity;
  }

  const seen = (R, [x, y, z]) => [0, 3, 6].map((row) => R[row] * x + R[row + 1] * y + R[row + 2] * z);

  /** Data of a set with what the pictures derive from it. */
  function prepared(article) {
    const set = JSON.parse(one("script.data", article).textContent);
    set.id = article.id;
    for (const camera of Object.values(set.cameras)) camera.fold = camera.lens ? foldOf(camera.lens) : Infinity;
    set.count = set.frames.true.length;
    for (const variant of set.variants) {
      variant.sizes = variant.errors.map((error) => (Array.isArray(error) ? Math.hypot(...error) : null));
      variant.sorted = Numbers.sorted(variant.sizes);
    }
    return set;
  }

  function Page(article) {
    const set = prepared(article);
    const diagonal = set.room ? Math.hypot(...set.room) : Infinity;
    const state = { unit: set.unit, chosen: set.variants[0], place: 0, order: [], range: null, cursor: null, marks: true };
    const find = (selector) => one(selector, article);
    const shown = () => set.variants.filter((variant) => variant.shown);
    const frame = () => state.order[state.place] ?? 0;
    const inUnit = (metres) => metres / Numbers.UNITS[state.unit];

    function limits() {
      const lists = shown().map((variant) => variant.sorted).filter((list) => list.length);
      if (set.bound) lists.push([set.bound[1]]);
      return Axes.limits(lists, diagonal);
    }

    // ---- unit of length
    function units() {
      for (const cell of all(".n[data-m]", article)) {
        const [whole, decimals] = Numbers.three(inUnit(Number(cell.dataset.m))).split(".");
        cell.replaceChildren(html("i", null, whole), html("b", null, decimals ? `.${decimals}` : ""));
      }
      for (const table of all("table", article)) {
        const digits = Math.max(0, ...all(".n b", table).map((cell) => cell.textContent.length));
        table.style.setProperty("--digits", `${0.64 * digits}em`);
      }
      for (const cell of all("[data-lo]", article)) {
        cell.textContent = `${Numbers.three(inUnit(Number(cell.dataset.lo)))} to ${Numbers.three(inUnit(Number(cell.dataset.hi)))}`;
      }
      for (const name of all(".unit", article)) name.textContent = state.unit;
      for (const button of all("[data-unit]", article)) button.setAttribute("aria-pressed", button.dataset.unit === state.unit);
    }

    // ---- pictures
    function strips() {
      const lists = set.variants.map((variant) => variant.sorted).filter((list) => list.length);
      const range = Axes.limits(lists, diagonal);
      Pictures.stripHead(find(".strip.head"), range);
      for (const row of all(".answer tr[data-variant]", article)) {
        Pictures.strip(one(".strip", row), set, set.variants.find((variant) => variant.name === row.dataset.variant), range);
      }
    }

    function curves() {
      const range = state.range || limits();
      const drawn = Pictures.curves(find(".curves"), set, shown(), range, state.cursor);
      const at = (event) => {
        const place = event.clientX - drawn.root.getBoundingClientRect().left;
        return Math.min(Math.max(drawn.across.value(place), range[0]), range[1]);
      };
      const drag = one(".drag", drawn.root);
      let from = null;
      drawn.root.addEventListener("pointermove", (event) => {
        state.cursor = at(event);
        Pictures.moveCursor(drawn.cross, drawn.across, state.cursor);
        reading();
        if (from === null) return;
        const [a, b] = [drawn.across.place(from), drawn.across.place(state.cursor)];
        drag.setAttribute("x", Math.min(a, b));
        drag.setAttribute("width", Math.abs(b - a));
      });
      drawn.root.addEventListener("pointerdown", (event) => {
        if (event.pointerType !== "mouse") return;
        from = at(event);
        event.preventDefault();
      });
      drawn.root.addEventListener("pointerup", (event) => {
        if (from === null) return;
        const to = at(event);
        if (Math.abs(drawn.across.place(from) - drawn.across.place(to)) > 12) zoom([Math.min(from, to), Math.max(from, to)]);
        from = null;
      });
      drawn.root.addEventListener("keydown", (event) => {
        const factor = { ArrowLeft: 1 / 1.1, ArrowRight: 1.1 }[event.key];
        if (factor) {
          state.cursor = Math.min(Math.max((state.cursor || Math.sqrt(range[0] * range[1])) * factor, range[0]), range[1]);
          Pictures.moveCursor(drawn.cross, drawn.across, state.cursor);
          reading();
          event.preventDefault();
        }
        if (event.key === "Escape" && state.range) {
          zoom(null);
          one("svg", find(".curves")).focus();
        }
      });
      find(".reset").hidden = !state.range;
      reading();
    }

    function zoom(range) {
      state.range = range;
      curves();
    }

    /** Shares at the cursor of the curves, in words. */
    function reading() {
      const box = find(".reading");
      if (state.cursor === null) {
        box.replaceChildren();
        return;
      }
      const share = (variant) => (100 * Numbers.below(variant.sorted, state.cursor)) / set.count;
      const words = shown().map((variant) => `${variant.name} ${Numbers.three(share(variant))} %`);
      box.replaceChildren(`Within ${Numbers.length(state.cursor)}: ${words.join(", ")}.`);
    }

    function room() {
      if (!set.room || !state.chosen) return;
      const { factor, scale } = Pictures.plan(find(".plan"), set, state.chosen, [0, 1], frame(), choose);
      Pictures.plan(find(".side"), set, state.chosen, [0, 2], frame(), choose);
      const times = factor >= 2 ? `Arrows are drawn ${factor < 100 ? Axes.plain(factor) : Numbers.three(factor)} times too long.` : "Arrows have the scale of the room.";
      find(".scale").replaceChildren(...Pictures.scaleKey(state.chosen, factor, scale), times);
      axes();
    }

    /** Table of the chosen variant's errors along each axis. */
    function axes() {
      const errors = state.chosen.errors.filter(Array.isArray);
      let any = false;
      const rows = [["x", 0], ["y", 1], ["z, up", 2]].map(([name, axis]) => {
        const along = errors.map((error) => error[axis]);
        if (along.length < 2) return html("tr", null, html("th", { scope: "row" }, name), html("td", { colspan: 3 }, "–"));
        const [mean, spread] = [Numbers.mean(along), Numbers.spread(along)];
        // Beyond 2.58 standard errors, 99 %, for each axis by itself.
        const biased = Math.abs(mean) > (2.58 * spread) / Math.sqrt(along.length);
        any = any || biased;
        const cells = [Numbers.three(inUnit(Numbers.median(along.map(Math.abs)))), `${Numbers.signed(inUnit(mean))}${biased ? " *" : ""}`, Numbers.three(inUnit(spread))];
        return html("tr", null, html("th", { scope: "row" }, name), ...cells.map((cell) => html("td", null, cell)));
      });
      const level = html("td", null, errors.length < 2 ? "–" : Numbers.three(inUnit(Numbers.median(errors.map(([x, y]) => Math.hypot(x, y))))));
      rows.push(html("tr", null, html("th", { scope: "row" }, "horizontal"), level, html("td"), html("td")));
      const heads = ["median size", "mean (bias)", "spread (1 σ)"].map((head) => html("th", { scope: "col" }, head));
      const caption = html("caption", { class: "note" }, `Where the error of ${state.chosen.name} lies, ${state.unit}; ${errors.length} frames`);
      find(".axes").replaceChildren(caption, html("thead", null, html("tr", null, html("td", { class: "l" }), ...heads)), html("tbody", null, ...rows));
      find(".biased").replaceChildren(any ? "* further from zero than chance explains (99 %, each axis by itself)." : "");
    }

    const MEASURES = [
      ["tilt of the optical axis, °", "tilt"],
      ["mean distance to the LEDs in view, m", "distance"],
      ["LEDs found", "found"],
      ["LEDs in view", "leds"],
      ["signal to noise of a pixel, median LED", "snr"],
    ];

    /** Whether a measure varies over the frames; LEDs in view are left out where those found are known. */
    function varies([, name]) {
      const known = set.frames[name].filter((value) => value !== null);
      const replaced = name === "leds" && set.frames.found.some((value) => value !== null);
      return !replaced && known.length > 2 && Math.min(...known) < Math.max(...known);
    }

    function depends() {
      const box = find(".depends");
      const chosen = MEASURES.filter(varies);
      // All boxes before the first picture: their widths depend on their number.
      const plots = chosen.map(() => html("div", { class: "plot" }));
      box.replaceChildren(...plots.map((plot) => html("figure", null, plot)));
      chosen.forEach(([title, name], index) => Pictures.scatter(plots[index], set, shown(), title, set.frames[name], limits(), frame(), choose));
    }

    // ---- frame by frame
    const ORDERS = { number: null, tilt: "tilt", distance: "distance", "LEDs in view": "leds", "signal to noise": "snr", bound: "bound" };

    function order(name) {
      const numbers = set.frames.true.map((_, index) => index);
      const variant = set.variants.find((candidate) => `error of ${candidate.name}` === name);
      const keys = variant ? variant.sizes : ORDERS[name] ? set.frames[ORDERS[name]] : numbers;
      const rank = (index) => (keys[index] === null ? Infinity : keys[index]);
      const kept = frame();
      state.order = numbers.sort((a, b) => rank(a) - rank(b) || a - b);
      state.place = Math.max(state.order.indexOf(kept), 0);
    }

    function choose(number) {
      if (number === null || number === undefined) return;
      state.place = Math.max(state.order.indexOf(number), 0);
      linked();
    }

    function step(by) {
      state.place = Math.min(Math.max(state.place + by, 0), set.count - 1);
      linked();
    }

    /** Draw what shows the chosen frame. */
    function linked() {
      if (!set.count) return;
      room();
      depends();
      browser();
    }

    function browser() {
      if (!set.count) return;
      const number = frame();
      Pictures.timeline(find(".timeline"), set, shown(), state.order, limits(), state.place, (place) => {
        state.place = place;
        linked();
      });
      find("input.frame").value = number;
      find("input.slide").value = state.place;
      find("input.slide").setAttribute("aria-valuetext", `frame ${number}`);
      find(".which").textContent = `Frame ${number}`;
      image(number);
      values(number);
      table(number);
    }

    /** Outlines of the LEDs in a camera's image: {path, centre} of each LED that has a whole one in view. */
    function outlines(number, camera) {
      const R = set.frames.R[number];
      const [px, py, pz] = set.frames.true[number];
      const [width, height] = camera.size;
      return set.leds.map(([id, x, y, z, square, radius]) => {
        const at = (du, dv) => pixel(camera, seen(R, [x + du - px, y + dv - py, z - pz]));
        const centre = at(0, 0);
        if (!centre || centre[0] < 0 || centre[1] < 0 || centre[0] > width || centre[1] > height) return null;
        const size = 1.25 * (radius || 0.01);
        const corners = square
          ? [[-1, -1], [1, -1], [1, 1], [-1, 1]]
          : Array.from({ length: 16 }, (_, index) => [Math.cos((index * Math.PI) / 8), Math.sin((index * Math.PI) / 8)]);
        const places = corners.map(([a, b]) => at(a * size, b * size));
        if (places.some((place) => !place)) return null;
        return { id, centre, path: `M${places.map(([u, v]) => `${u.toFixed(1)} ${v.toFixed(1)}`).join("L")}z` };
      });
    }

    function image(number) {
      const box = find(".pic");
      const camera = set.cameras[set.frames.camera[number]];
      const content = set.pictures[number];
      const parts = [];
      if (content) parts.push(html("img", { alt: `preview of frame ${number}`, src: `data:image/webp;base64,${content}` }));
      const fits = camera && (!content || Math.abs(set.aspects[number] - camera.size[0] / camera.size[1]) < 0.02);
      const offsets = [];
      if (camera && camera.outlines && fits && (state.marks || !content)) {
        const [width, height] = camera.size;
        const drawn = outlines(number, camera);
        const flat = set.spots[number] || [];
        const used = new Map();
        for (let index = 0; index < flat.length; index += 3) used.set(flat[index], [flat[index + 1] / 1000, flat[index + 2] / 1000]);
        const overlay = svg("svg", { viewBox: `0 0 ${width} ${height}`, role: "img", "aria-label": `LEDs of frame ${number}` });
        drawn.forEach((led, index) => {
          if (!led) return;
          const spot = used.get(index);
          const unused = set.spots[number] && !spot;
          overlay.append(svg("path", { class: `outline${unused ? " unused" : ""}`, d: led.path }, svg("title", null, `LED ${led.id}`)));
          if (!spot) return;
          const [u, v] = [led.centre[0] + spot[0], led.centre[1] + spot[1]];
          const arm = width / 250;
          overlay.append(svg("path", { class: "spot", d: `M${u - arm} ${v}h${2 * arm}M${u} ${v - arm}v${2 * arm}` }));
          offsets.push(spot);
        });
        parts.push(overlay);
      } else {
        const flat = set.spots[number] || [];
        for (let index = 0; index < flat.length; index += 3) offsets.push([flat[index + 1] / 1000, flat[index + 2] / 1000]);
      }
      box.replaceChildren(...parts);
      const words = [];
      if (!content) words.push(camera ? "Drawn from the map: the page holds no picture of this frame." : "The page holds no picture of this frame.");
      if (fits && camera.outlines && (state.marks || !content)) {
        words.push("Blue: outlines of LEDs at the true pose, a quarter wider.");
        if (set.spots[number]) words.push("Pink: spots found. Orange, dashed: in view, not identified.");
      }
      find(".legendary").textContent = words.join(" ");
      find(".offsets").hidden = !offsets.length;
      if (offsets.length) Pictures.target(find(".target"), offsets);
    }

    function values(number) {
      const data = set.frames;
      const R = data.R[number];
      const degrees = (radians) => `${((radians * 180) / Math.PI).toFixed(1)}°`;
      const rows = [["position x, y, z", `${data.true[number].map((value) => Number(value.toFixed(3))).join(", ")} m`]];
      if (R) {
        // R = Rx(tilt_x) Ry(tilt_y) Rz(yaw), datasets/FORMAT.md.
        const [tiltX, tiltY, yaw] = [Math.atan2(R[5], R[8]), Math.asin(Math.max(-1, Math.min(1, -R[2]))), Math.atan2(R[1], R[0])];
        rows.push(["tilt x, y; yaw", [tiltX, tiltY, yaw].map(degrees).join(", ")]);
      }
      rows.push(["axis off the vertical", `${data.tilt[number].toFixed(1)}°`]);
      const found = data.found[number];
      rows.push(found === null ? ["LEDs in view", data.leds[number]] : ["LEDs found, of in view", `${found} of ${data.leds[number]}`]);
      if (data.distance[number] !== null) rows.push(["mean distance", `${Numbers.three(data.distance[number])} m`]);
      if (data.snr[number] !== null) rows.push(["signal to noise", Numbers.three(data.snr[number])]);
      if (data.gravity[number] !== null && data.gravity[number] !== undefined) rows.push(["accelerometer off by", `${Numbers.three(data.gravity[number])}°`]);
      if (data.exposure[number]) rows.push(["exposure", `${Numbers.three(data.exposure[number] * 1e6)} µs`]);
      if (new Set(data.device).size > 1) rows.push(["device", data.device[number]]);
      if (Object.keys(set.cameras).length > 1) rows.push(["camera", data.camera[number]]);
      if (data.bound[number] !== null) rows.push(["bound, this frame", Numbers.length(data.bound[number])]);
      find(".kv").replaceChildren(...rows.map(([name, value]) => html("div", null, html("dt", null, name), html("dd", null, String(value)))));
    }

    function table(number) {
      const heads = ["3D", "horizontal", "height", ...(set.bound ? ["÷\u00a0bound"] : []), "ms"];
      const rows = shown().map((variant) => {
        const name = html("th", { scope: "row" }, Axes.key(variant, set.shapes), Axes.named(variant.name));
        const error = variant.errors[number];
        if (!Array.isArray(error)) {
          return html("tr", null, name, html("td", { class: "failing l wrap", colspan: heads.length }, `failed: ${set.reasons[error]}`));
        }
        const size = variant.sizes[number];
        const bound = set.frames.bound[number];
        const cells = size > diagonal
          ? ["out", "out", "out"]
          : [Numbers.three(inUnit(size)), Numbers.three(inUnit(Math.hypot(error[0], error[1]))), Numbers.signed(inUnit(error[2]))];
        if (set.bound) cells.push(!bound ? "–" : size > diagonal ? "out" : Numbers.three(size / bound));
        cells.push(Numbers.three(variant.ms[number]));
        return html("tr", { "data-variant": variant.name }, name, ...cells.map((cell) => html("td", null, cell)));
      });
      const head = html("tr", null, html("th", { scope: "col", class: "l" }, `variant, ${state.unit}`), ...heads.map((text) => html("th", { scope: "col" }, text)));
      find(".frame-table").replaceChildren(html("thead", null, head), html("tbody", null, ...rows));
    }

    // ---- controls
    function controls() {
      for (const part of all(".scripted", article)) part.hidden = false;
      const legend = find(".legend");
      for (const variant of set.variants) {
        const chip = html("button", { type: "button", class: "btn", "aria-pressed": String(variant.shown) }, Axes.key(variant, set.shapes), variant.name);
        chip.addEventListener("click", () => {
          variant.shown = !variant.shown;
          chip.setAttribute("aria-pressed", variant.shown);
          state.range = null;
          curves();
          depends();
          browser();
        });
        legend.append(chip);
      }
      for (const button of all("[data-unit]", article)) {
        button.addEventListener("click", () => {
          state.unit = button.dataset.unit;
          units();
          if (!set.count) return;
          if (set.room) axes();
          table(frame());
        });
      }
      find(".reset").addEventListener("click", () => zoom(null));
      const choice = find("select.one");
      if (choice) {
        choice.append(...set.variants.map((variant) => html("option", null, variant.name)));
        choice.addEventListener("change", () => {
          state.chosen = set.variants[choice.selectedIndex];
          room();
        });
      }
      const orders = find("select.order");
      const known = Object.keys(ORDERS).filter((name) => !ORDERS[name] || set.frames[ORDERS[name]].some((value) => value !== null));
      orders.append(...[...known, ...set.variants.map((variant) => `error of ${variant.name}`)].map((name) => html("option", null, name)));
      orders.addEventListener("change", () => {
        order(orders.value);
        browser();
      });
      find("input.frame").addEventListener("change", (event) => choose(Math.min(Math.max(Math.round(Number(event.target.value)) || 0, 0), set.count - 1)));
      find("input.slide").addEventListener("input", (event) => {
        state.place = Number(event.target.value);
        linked();
      });
      for (const button of all(".step", article)) button.addEventListener("click", () => step(Number(button.dataset.step)));
      find(".marks").addEventListener("click", (event) => {
        state.marks = !state.marks;
        event.currentTarget.setAttribute("aria-pressed", state.marks);
        image(frame());
      });
    }

    function draw() {
      // A window that has no size yet, in a tab behind others, gets its pictures with its size.
      if (article.hidden || !article.clientWidth || !set.variants.length || !set.count) return;
      strips();
      curves();
      linked();
    }

    if (set.variants.length && set.count) {
      order("number");
      controls();
    }
    units();
    return { draw };
  }

  const articles = all("article", document);
  const pages = articles.map(Page);
  const draw = () => pages.forEach((page) => page.draw());

  function tabs() {
    const bar = one(".tabs", document);
    if (!bar) return;
    bar.hidden = false;
    const buttons = all("button", bar);
    const open = (index) => {
      buttons.forEach((button, place) => {
        button.setAttribute("aria-selected", place === index);
        button.tabIndex = place === index ? 0 : -1;
        articles[place].hidden = place !== index;
      });
      pages[index].draw();
    };
    buttons.forEach((button, index) => {
      button.addEventListener("click", () => open(index));
      button.addEventListener("keydown", (event) => {
        const by = { ArrowRight: 1, ArrowLeft: -1 }[event.key];
        if (!by) return;
        const next = (index + by + buttons.length) % buttons.length;
        open(next);
        buttons[next].focus();
        event.preventDefault();
      });
    });
    open(0);
  }

  tabs();
  draw();
  let waiting = 0;
  let width = document.documentElement.clientWidth;
  window.addEventListener("resize", () => {
    cancelAnimationFrame(waiting);
    waiting = requestAnimationFrame(() => {
      if (document.documentElement.clientWidth === width) return;
      width = document.documentElement.clientWidth;
      draw();
    });
  });
  window.matchMedia("(prefers-color-scheme: dark)").addEventListener("change", draw);

  // report.css has a layout of the width of paper, in light colours, for `printing`.
  const print = (on) => {
    document.documentElement.classList.toggle("printing", on);
    draw();
  };
  window.addEventListener("beforeprint", () => print(true));
  window.addEventListener("afterprint", () => print(false));
})();
