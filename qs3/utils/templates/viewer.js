// Clouds on a page: each has a canvas of its own and is drawn point by point with a depth buffer.
//
// Everything comes from the JSON in #clouds (see page.py). A point is a small ball seen from far
// away (orthographic, z up), paler the farther it is. Names get into the page as text, never as
// HTML. No WebGL: browsers stop at some 16 of its contexts, and this needs none.
"use strict";
(() => {
  const page = JSON.parse(document.getElementById("clouds").textContent);
  const START = { ...page.start, zoom: 1, x: 0, y: 0 };
  const PAPER = [247, 248, 250], PALE = [237, 240, 245], UNKNOWN = [176, 182, 192];
  const find = (id) => document.getElementById(id);
  const grid = find("grid"), colour = find("colour"), list = find("list"), words = find("words");
  const together = find("together"), true_size = find("true-size"), size = find("size");
  const largest = Math.max(...page.clouds.map((cloud) => cloud.radius));
  let shared = { ...START }, single = -1;

  const element = (name, style, text = "") => {
    const made = document.createElement(name);
    made.className = style;
    made.textContent = text;
    return made;
  };

  const bytes = (base64) => Uint8Array.from(atob(base64), (letter) => letter.charCodeAt(0));

  // Places about the middle of the box, in units of the farthest one's distance: [x, y, z, ...].
  function places(cloud) {
    const raw = new DataView(bytes(cloud.xyz).buffer), found = new Float32Array(3 * cloud.count);
    for (let i = 0; i < found.length; i++)
      found[i] = (raw.getUint16(2 * i, true) * cloud.step - cloud.size[i % 3] / 2) / cloud.radius;
    return found;
  }

  function ramp(share) {
    const at = Math.min(Math.max(share, 0), 1) * (page.ramp.length - 1);
    const low = Math.min(Math.floor(at), page.ramp.length - 2);
    return page.ramp[low].map((v, k) => v + (at - low) * (page.ramp[low + 1][k] - v));
  }
  const hue = (table, k) => (k < 0 ? UNKNOWN : table[k % table.length]);

  // The colour of each point, [r, g, b, ...] of 0 to 255.
  const COLOURS = {
    height: (cloud, xyz) => {
      const tall = cloud.size[2] / cloud.radius;
      return (i) => ramp(tall ? 0.02 + 0.86 * (xyz[3 * i + 2] / tall + 0.5) : 0.02);
    },
    class: (cloud) => () => hue(page.class_colours, page.classes.indexOf(kind(cloud))),
    confidence: (cloud) => () => (cloud.sure === null ? UNKNOWN : ramp(cloud.sure)),
  };
  const kind = (cloud) => cloud.label || cloud.called;

  function paint(card) {
    card.xyz ??= places(card.cloud);
    const of = COLOURS[colour.value](card.cloud, card.xyz);
    card.rgb = new Uint8Array(3 * card.cloud.count);
    for (let i = 0; i < card.cloud.count; i++) card.rgb.set(of(i), 3 * i);
  }

  // The pixels of a ball of so many pixels across, from its upper left corner: steps right and
  // down, and how bright it is there.
  function ball(across) {
    const found = [], middle = (across - 1) / 2;
    for (let v = 0; v < across; v++)
      for (let u = 0; u < across; u++) {
        const off = ((u - middle) ** 2 + (v - middle) ** 2) / (across / 2) ** 2;
        if (off <= 1) found.push([u, v, across < 4 ? 1 : 1 - 0.3 * off]);
      }
    return found;
  }

  function draw(card) {
    const side = Math.round(card.canvas.clientWidth * (window.devicePixelRatio || 1));
    if (!side) return;
    if (!card.rgb) paint(card);
    const { canvas, xyz, rgb, cloud } = card, eye = together.checked ? shared : card.eye;
    if (canvas.width !== side) canvas.width = canvas.height = side;
    const context = canvas.getContext("2d"), picture = context.createImageData(side, side);
    const pixels = new Uint32Array(picture.data.buffer), depth = new Float32Array(side * side);
    pixels.fill((255 << 24) | (PAPER[2] << 16) | (PAPER[1] << 8) | PAPER[0]);
    depth.fill(-Infinity);
    const a = ((eye.azimuth + cloud.turn) * Math.PI) / 180, e = (eye.elevation * Math.PI) / 180;
    const right = [-Math.sin(a), Math.cos(a), 0];
    const up = [-Math.sin(e) * Math.cos(a), -Math.sin(e) * Math.sin(a), Math.cos(e)];
    const near = [Math.cos(e) * Math.cos(a), Math.cos(e) * Math.sin(a), Math.sin(e)];
    const scale = 0.48 * side * eye.zoom * (true_size.checked ? cloud.radius / largest : 1);
    const middle = [side * (0.5 + eye.x), side * (0.5 + eye.y)];
    const usual = Math.min(Math.max((1.2 * scale) / Math.sqrt(cloud.count), 2), side / 24);
    const across = Math.max(Math.round(usual * 2 ** Number(size.value)), 1), disc = ball(across);
    const left = middle[0] - across / 2 + 0.5, top = middle[1] - across / 2 + 0.5;
    for (let i = 0; i < cloud.count; i++) {
      const x = xyz[3 * i], y = xyz[3 * i + 1], z = xyz[3 * i + 2];
      const toward = x * near[0] + y * near[1] + z * near[2];
      const column = Math.floor(left + scale * (x * right[0] + y * right[1]));
      const row = Math.floor(top - scale * (x * up[0] + y * up[1] + z * up[2]));
      const fresh = 0.35 + 0.325 * (1 + toward), faded = 1 - fresh;
      const r = fresh * rgb[3 * i] + faded * PALE[0];
      const g = fresh * rgb[3 * i + 1] + faded * PALE[1];
      const b = fresh * rgb[3 * i + 2] + faded * PALE[2];
      for (const [u, v, light] of disc) {
        const at_u = column + u, at_v = row + v;
        if (at_u < 0 || at_v < 0 || at_u >= side || at_v >= side) continue;
        const at = at_v * side + at_u;
        if (depth[at] >= toward) continue;
        depth[at] = toward;
        pixels[at] = (255 << 24) | ((light * b) << 16) | ((light * g) << 8) | (light * r);
      }
    }
    context.putImageData(picture, 0, 0);
  }

  // What has to be drawn is drawn once, before the browser shows its next picture.
  const waiting = new Set();
  function redraw(cards = all) {
    if (!waiting.size)
      requestAnimationFrame(() => {
        const now = [...waiting];
        waiting.clear();
        now.forEach(draw);
      });
    for (const card of cards) if (card.seen) waiting.add(card);
  }
  const watch = new IntersectionObserver((entries) => {
    for (const entry of entries) {
      const card = all[entry.target.dataset.place];
      card.seen = entry.isIntersecting;
      if (card.seen) redraw([card]);
    }
  }, { rootMargin: "200px" });

  function move(card, change) {
    const eye = together.checked ? shared : card.eye;
    change(eye);
    eye.elevation = Math.min(Math.max(eye.elevation, -90), 90);
    eye.zoom = Math.min(Math.max(eye.zoom, 0.2), 40);
    redraw(together.checked ? all : [card]);
  }

  // One finger or button turns, two fingers or shift move and zoom; a short press opens.
  function listen(card) {
    const { canvas } = card, fingers = new Map();
    let moved = 0;
    const spread = () => {
      const [a, b] = [...fingers.values()];
      return [(a.x + b.x) / 2, (a.y + b.y) / 2, Math.hypot(a.x - b.x, a.y - b.y) || 1];
    };
    canvas.addEventListener("pointerdown", (event) => {
      canvas.setPointerCapture(event.pointerId);
      fingers.set(event.pointerId, { x: event.clientX, y: event.clientY });
      moved = 0;
    });
    canvas.addEventListener("pointermove", (event) => {
      const last = fingers.get(event.pointerId);
      if (!last) return;
      const before = fingers.size === 2 && spread();
      const x = event.clientX - last.x, y = event.clientY - last.y, wide = canvas.clientWidth;
      fingers.set(event.pointerId, { x: event.clientX, y: event.clientY });
      moved += Math.abs(x) + Math.abs(y);
      move(card, (eye) => {
        if (before) {
          const after = spread();
          eye.x += (after[0] - before[0]) / wide;
          eye.y += (after[1] - before[1]) / wide;
          eye.zoom *= after[2] / before[2];
        } else if (event.shiftKey || event.buttons & 6) {
          eye.x += x / wide;
          eye.y += y / wide;
        } else {
          eye.azimuth -= (x * 240) / wide;
          eye.elevation += (y * 240) / wide;
        }
      });
    });
    for (const end of ["pointerup", "pointercancel"])
      canvas.addEventListener(end, (event) => {
        fingers.delete(event.pointerId);
        if (end === "pointerup" && moved < 4 && event.button === 0 && single < 0) show(card.place);
      });
    canvas.addEventListener("contextmenu", (event) => event.preventDefault());
    canvas.addEventListener("wheel", (event) => {
      if (single < 0 && !event.ctrlKey) return; // the page scrolls
      event.preventDefault();
      move(card, (eye) => { eye.zoom *= Math.exp(-event.deltaY / 400); });
    }, { passive: false });
    canvas.addEventListener("keydown", (event) => {
      const turn = {
        ArrowLeft: (eye) => { eye.azimuth += 10; }, ArrowRight: (eye) => { eye.azimuth -= 10; },
        ArrowUp: (eye) => { eye.elevation += 10; }, ArrowDown: (eye) => { eye.elevation -= 10; },
        "+": (eye) => { eye.zoom *= 1.2; }, "-": (eye) => { eye.zoom /= 1.2; },
        Enter: () => show(single < 0 ? card.place : -1),
      }[event.key];
      if (!turn) return;
      event.preventDefault();
      move(card, turn);
    });
  }

  const number = (value) => Number(value.toPrecision(3)).toString();
  function make(cloud, place) {
    const wrong = cloud.label && cloud.called && cloud.label !== cloud.called;
    const style = wrong ? "wrong" : cloud.label && cloud.called ? "right" : "";
    const box = element("div", `card ${style}`), canvas = element("canvas", "");
    box.dataset.place = place;
    canvas.tabIndex = 0;
    canvas.setAttribute("role", "img");
    canvas.setAttribute("aria-label", `the cloud ${cloud.name}; arrow keys turn it`);
    box.append(canvas);
    if (cloud.called) {
      const said = element("div", "");
      said.append(element("span", "said", `${cloud.called} ${Math.round(100 * cloud.sure)}%`));
      if (cloud.label) said.append(wrong ? ` is ${cloud.label}` : " right");
      box.append(said);
    } else if (cloud.label) box.append(element("div", "said", cloud.label));
    box.append(element("div", "file", cloud.name));
    if (cloud.note) box.append(element("div", "file", cloud.note));
    const extent = cloud.size.map(number).join("\u00a0×\u00a0") + (page.unit && `\u00a0${page.unit}`);
    const of = cloud.of > cloud.count ? ` of ${cloud.of}` : "";
    box.append(element("div", "file", `${cloud.count}${of} points, ${extent}`));
    const card = { cloud, place, box, canvas, eye: { ...START }, seen: false };
    card.text = box.textContent.toLowerCase() + (style && ` ${style}`);
    return card;
  }

  function legend() {
    const box = find("legend"), mode = colour.value;
    const entry = (rgb, text) => {
      const dot = element("span", "dot");
      dot.style.background = `rgb(${rgb.map(Math.round)})`;
      const made = element("span", "entry");
      made.append(dot, text);
      return made;
    };
    const bar = (low, high, from = 0, to = 1) => {
      const strip = element("span", "strip"), steps = [0, 0.25, 0.5, 0.75, 1];
      const colours = steps.map((s) => `rgb(${ramp(from + s * (to - from)).map(Math.round)})`);
      strip.style.background = `linear-gradient(90deg, ${colours})`;
      return [low, strip, high];
    };
    const shown = {
      height: () => bar("low", "high", 0.02, 0.88),
      confidence: () => bar("0%", "100%"),
      class: () => page.classes.map((name, k) => entry(hue(page.class_colours, k), name)),
    };
    box.replaceChildren(...shown[mode]());
  }

  // One cloud, large; -1: all of them.
  function show(place) {
    single = place;
    list.value = String(place);
    document.body.classList.toggle("single", place >= 0);
    sift();
  }
  function sift() {
    const wanted = words.value.toLowerCase().split(/\s+/);
    let shown = 0;
    for (const card of all) {
      const there = single < 0 ? wanted.every((w) => card.text.includes(w)) : card.place === single;
      card.box.hidden = !there;
      shown += there;
    }
    find("count").textContent = single < 0 && shown < all.length ? `${shown} shown` : "";
    redraw();
  }
  const step = (by) => show((single + by + all.length) % all.length);

  const all = page.clouds.map(make);
  list.append(new Option(all.length > 1 ? `all ${all.length} clouds` : "the cloud", -1));
  for (const { cloud, place } of all) list.append(new Option(cloud.name, place));
  for (const mode of page.modes) colour.append(new Option(mode, mode));
  grid.append(...all.map((card) => card.box));
  for (const card of all) {
    listen(card);
    watch.observe(card.box);
  }
  colour.addEventListener("change", () => {
    for (const card of all) card.rgb = null;
    legend();
    redraw();
  });
  list.addEventListener("change", () => show(Number(list.value)));
  words.addEventListener("input", sift);
  for (const input of [together, true_size, size]) input.addEventListener("input", () => redraw());
  find("before").addEventListener("click", () => step(-1));
  find("after").addEventListener("click", () => step(1));
  find("back").addEventListener("click", () => show(-1));
  find("reset").addEventListener("click", () => {
    shared = { ...START };
    for (const card of all) card.eye = { ...START };
    redraw();
  });
  addEventListener("keydown", (event) => {
    if (single < 0 || event.target === words) return;
    if (event.key === "Escape") show(-1);
    if (event.key === "PageDown" || event.key === "PageUp") {
      event.preventDefault();
      step(event.key === "PageDown" ? 1 : -1);
    }
  });
  addEventListener("resize", () => redraw());
  legend();
  document.body.classList.toggle("sole", all.length === 1);
  show(all.length === 1 ? 0 : -1);
})();
