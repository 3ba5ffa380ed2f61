// The page: panel, state and overlays. Text from the scene is never set as HTML.

import { readPage } from "./data.js";
import { PhraseError } from "./encoder.js";
import { Language } from "./language.js";
import { Controls, cornersOf, project } from "./camera.js";
import { Painter } from "./draw.js";
import { Headset } from "./headset.js";
import { wholeOf } from "./rule.js";

// [page]
const byId = (id) => document.getElementById(id);
const element = (tag, text, properties = {}) =>
  Object.assign(document.createElement(tag), { textContent: text }, properties);
const LEVELS = { auto: "Auto", subpart: "Subpart", part: "Part", whole: "Whole" };
const DISPLAYS = { rgb: "Colours", relevancy: "Relevancy", segmentation: "Found", latent: "Latent" };
const OF_ANSWERS = ["relevancy", "segmentation"]; // displays that need an answer
const HEATS = { smooth: "Smoothed", own: "Each Gaussian", node: "Each node", everywhere: "Everywhere" };
const OUTCOMES = { found: "found", "weak match": "weak", "not here": "none" }; // class names of verdicts
const KEYS = { c: "rgb", r: "relevancy", f: "segmentation", l: "latent" };
const BUTTONS = { t: "spin", p: "picture", b: "boxes", h: "fold", "[": "before", "]": "after" };
const SLOW = 60; // ms per frame above which the resolution is reduced while the camera moves
const COARSEST = 0.3; // least share of the pixels in a row
const REST = 180; // ms without a change after which the full resolution is drawn
const MOST_BOXES = 24;
// Pairs of corners at the twelve edges of a box; corners are numbered by three bits.
const EDGES = [0, 1, 2, 3, 4, 5, 6, 7].flatMap((corner) => {
  return [1, 2, 4].filter((bit) => !(corner & bit)).map((bit) => [corner, corner | bit]);
});

class Page {
  constructor(meta, tensors) {
    Object.assign(this, { meta, level: "auto", display: "rgb", answers: [], shown: [] });
    Object.assign(this, { share: COARSEST, coarse: true, moving: true }); // of the pixels; only large Gaussians
    this.painter = new Painter(byId("scene"), meta, tensors);
    this.painter.onorder = () => this.redraw();
    this.language = meta.language && new Language(meta.language, tensors, this.painter.places);
    this.controls = new Controls(byId("scene"), this);
    this.headset = new Headset(this);
    byId("panel").hidden = false;
    this.fill();
    this.listenToSearch();
    this.listenToButtons();
    addEventListener("resize", () => this.redraw());
    addEventListener("keydown", (event) => this.key(event));
    addEventListener("hashchange", () => this.open());
    addEventListener("beforeprint", () => this.paint(true));
    addEventListener("afterprint", () => this.redraw());
    this.panel(true);
    this.open();
  }

  // Fill the panel for this scene.
  fill() {
    this.fillRadios("levels", LEVELS, "auto");
    this.fillRadios("displays", DISPLAYS, "rgb");
    byId("views").append(...this.meta.views.map(({ name }, value) => element("option", name, { value })));
    for (const id of ["before", "after", "views"]) {
      byId(id).hidden = this.meta.views.length < 2;
    }
    const { maps, colour_map, heat } = this.meta.picture;
    for (const [id, texts, chosen] of [
      ["heat", Object.entries(HEATS), heat],
      ["map", maps.map((name) => [name, name]), colour_map],
    ]) {
      byId(id).append(...texts.map(([value, text]) => element("option", text, { value })));
      byId(id).value = chosen;
      byId(id).addEventListener("change", () => this.update());
    }
    const gaussians = `${this.painter.count.toLocaleString("en")} Gaussians`;
    const { language } = this.meta;
    let about = `Nothing can be searched: ${this.meta.why_not}.`;
    if (language) {
      const asked = language.encoder
        ? "The text encoder is in this page: ask any of its words, in any combination."
        : `${this.language.keys.size.toLocaleString("en")} phrases can be asked.`;
      about = `${asked} Answers: ${language.basis}.`;
    }
    byId("about").textContent = `${gaussians}. ${about} Made with the LangSplat viewer.`;
    for (const part of document.querySelectorAll(".asks")) {
      part.hidden = !language;
    }
    byId("labels").hidden = !language && !this.meta.notes.length;
    byId("about").parentElement.open = !language; // says why
    const examples = language?.examples ?? [];
    if (examples.length) {
      byId("phrase").placeholder = `${examples.slice(0, 2).join(", ")} …`;
    }
    const offered = language ? [...this.language.taught.keys(), ...language.phrases] : [];
    byId("list").append(...offered.map((value) => element("option", "", { value })));
    byId("examples").append(...examples.map((phrase) => this.searchButton(phrase, phrase)));
  }

  // A button that searches for a phrase.
  searchButton(text, phrase) {
    return element("button", text, { type: "button", onclick: () => this.search(phrase) });
  }

  fillRadios(id, texts, chosen) {
    for (const [value, text] of Object.entries(texts)) {
      const input = element("input", "", { type: "radio", name: id, value, checked: value === chosen });
      input.addEventListener("change", () => this.choose(id, value));
      const label = element("label", text);
      label.prepend(input);
      byId(id).append(label);
    }
  }

  listenToSearch() {
    const input = byId("phrase");
    byId("search").addEventListener("submit", (event) => {
      event.preventDefault();
      this.search(input.value);
    });
    input.addEventListener("input", (event) => {
      byId("clear").hidden = !input.value;
      if (!event.inputType || event.inputType === "insertReplacementText") {
        this.search(input.value); // an entry of the list was chosen
      }
    });
    input.addEventListener("keydown", ({ key }) => key === "Escape" && this.search(""));
    byId("clear").addEventListener("click", () => {
      this.search("");
      input.focus();
    });
  }

  listenToButtons() {
    byId("face").addEventListener("click", () => this.controls.face(this.shown[0].corners));
    byId("boxes").addEventListener("change", () => this.redraw());
    byId("views").addEventListener("change", () => this.view(+byId("views").value));
    byId("before").addEventListener("click", () => this.view(this.current - 1));
    byId("after").addEventListener("click", () => this.view(this.current + 1));
    byId("fold").addEventListener("click", () => this.panel(byId("controls").hidden));
    byId("full").hidden = !document.fullscreenEnabled;
    byId("full").addEventListener("click", () =>
      document.fullscreenElement ? document.exitFullscreen() : document.body.requestFullscreen(),
    );
    byId("picture").addEventListener("click", () => this.save());
    byId("spin").addEventListener("click", () => (byId("spin").ariaPressed = String(this.controls.spin())));
    const offer = (offered) => (byId("headset").hidden = !offered);
    navigator.xr?.isSessionSupported("immersive-vr").then(offer, () => {}); // rejects in a frame without permission
    const refused = (problem) => this.update(Object.assign(this, { problem }));
    byId("headset").addEventListener("click", () => this.headset.toggle().catch(refused));
    let { matches: light } = matchMedia("(prefers-color-scheme: light)");
    byId("theme").addEventListener("click", () => {
      light = !light;
      document.documentElement.style.colorScheme = light ? "light" : "dark";
    });
  }

  key(event) {
    const typing = event.target.matches("select, input[type=text]");
    const key = event.key.toLowerCase();
    if (event.ctrlKey || event.metaKey || event.altKey || typing) {
      return;
    }
    if (BUTTONS[key]) {
      byId(BUTTONS[key]).click();
    } else if (this.language && key === "/") {
      byId("phrase").focus();
      byId("phrase").select();
    } else if (this.language && "0123".includes(key)) {
      this.choose("levels", ["auto", ...this.meta.language.levels][key]);
    } else if (this.language && KEYS[key]) {
      this.choose("displays", KEYS[key]);
    } else if (event.target.matches("input") || !this.controls.key(event)) {
      return; // arrows choose among radio buttons
    }
    event.preventDefault();
  }

  // Left, top, width and height of the area without the panel, which is at the left, on phones at the bottom.
  free() {
    const { right, top } = byId("panel").getBoundingClientRect();
    return right < 0.6 * innerWidth ? [right, 0, innerWidth - right, innerHeight] : [0, 0, innerWidth, top];
  }

  // Fold or unfold the panel below its title and search box.
  panel(shown) {
    byId("controls").hidden = !shown;
    byId("fold").ariaExpanded = String(shown);
    byId("fold").ariaLabel = shown ? "Fold the panel" : "Unfold the panel";
    this.redraw();
  }

  // The state in the address after "#": phrase, level, display, view and, if it was changed, the pose. Defaults are
  // left out.
  state() {
    const { phrase, level, display, current } = this;
    const { rotation, position } = this.controls.end;
    const own = this.meta.views[current];
    const said = { phrase, level, show: display, view: current || "" };
    if (position.some((length, i) => length !== own.position[i]) || rotation !== own.rotation) {
      const numbers = [...position, ...rotation.slice(3), this.controls.distance];
      said.at = numbers.map((number) => +number.toPrecision(6));
    }
    const told = Object.entries(said).filter(([, value]) => !["", "auto", "rgb"].includes(value));
    return `#${new URLSearchParams(told)}`;
  }

  // Put the state into the address, as a new entry of the browser's history or in place of the last one.
  remember(step) {
    this.address = this.state();
    if (this.address === (location.hash || "#") || location.protocol === "about:") {
      return; // a page in a notebook has no own address
    }
    location[step ? "assign" : "replace"](this.address);
  }

  // Take the state from the address.
  open() {
    if (location.hash === this.address) {
      return;
    }
    this.address = location.hash;
    const said = new URLSearchParams(location.hash.slice(1) || this.meta.address);
    const [level, show, view] = ["level", "show", "view"].map((name) => said.get(name));
    this.level = Object.hasOwn(LEVELS, level) ? level : "auto";
    const numbers = (said.get("at") ?? "").split(",").map(Number);
    this.current = this.meta.views[view] ? +view : 0;
    byId("views").value = this.current;
    const known = numbers.length === 10 && numbers.every((number) => Math.abs(number) < 1e6);
    this.controls.go(this.meta.views[this.current], known ? numbers : null);
    this.display = "rgb";
    if (this.language) {
      this.take((said.get("phrase") ?? "").slice(0, 400));
      const shows = this.answers.length || !OF_ANSWERS.includes(show);
      this.display = Object.hasOwn(DISPLAYS, show) && shows ? show : "rgb";
    }
    this.update();
  }

  search(phrase) {
    this.take(phrase);
    this.remember(true);
  }

  take(phrase) {
    byId("phrase").value = phrase;
    byId("clear").hidden = !phrase;
    this.phrase = phrase;
    if (!phrase.trim() && OF_ANSWERS.includes(this.display)) {
      this.display = "rgb";
    } else if (phrase.trim() && !this.answers.length && this.display === "rgb") {
      this.display = "relevancy";
    }
    this.ask();
  }

  ask() {
    this.problem = null;
    this.answers = [];
    if (this.phrase?.trim()) {
      try {
        this.answers = this.language.answers(this.phrase, this.level, this.controls.view);
      } catch (error) {
        if (!(error instanceof PhraseError)) {
          throw error;
        }
        this.problem = error;
      }
    }
    this.shown = this.answers.flatMap((answer) =>
      this.boxes(answer).map((corners, rank) => ({ corners, name: rank ? "" : answer.phrase })),
    );
    this.update();
  }

  choose(what, value) {
    if (what === "levels") {
      this.level = value;
      this.ask();
    } else if (!document.querySelector(`#displays [value=${value}]`).disabled) {
      this.display = value;
      this.update();
    }
    this.remember(true);
  }

  // Update the panel and the values of the Gaussians for phrase, level and display.
  update() {
    const { answers, problem } = this;
    const hot = this.hot();
    const said = byId("verdict");
    const levels = this.meta.language?.levels ?? [];
    for (const input of document.querySelectorAll("fieldset input")) {
      input.checked = [this.level, this.display].includes(input.value);
      input.disabled = OF_ANSWERS.includes(input.value) && !answers.length;
    }
    for (const button of byId("examples").children) {
      button.ariaPressed = String(answers.length > 0 && button.textContent === this.phrase);
    }
    said.replaceChildren(...answers.map((answer) => this.said(answer)));
    byId("answer").hidden = !this.shown.length;
    const heated = this.display === "relevancy";
    byId("legend").style.visibility = heated && hot.length === 1 ? "visible" : "hidden";
    byId("looks").hidden = !heated || !hot.length;
    byId("map").disabled = hot.length > 1; // they have their own colours
    if (hot.length === 1) {
      this.legend(hot[0]);
    }
    const left = answers.left?.join(", ");
    said.append(problem?.message ?? (left ? element("small", `Three at a time; not asked: ${left}`) : ""));
    if (problem?.near) {
      const inner = problem.word.replace(/[^\p{L}\p{N}]+/gu, "[^\\p{L}\\p{N}]+"); // between words: as typed
      const whole = new RegExp(`(?<![\\p{L}\\p{N}])${inner}(?![\\p{L}\\p{N}])`, "gu");
      const meant = this.phrase.toLowerCase().replace(whole, () => problem.near);
      said.append(" ", this.searchButton(`Did you mean “${meant}”?`, meant));
    }
    if (this.display === "latent") {
      this.painter.show(this.language.latents(this.level === "auto" ? 2 : levels.indexOf(this.level)));
    } else if (this.display !== "rgb") {
      const heats = (answer) => this.language.heats(answer, byId("heat").value, this.meta.picture.heat_base);
      this.painter.show(hot.map(this.display === "segmentation" ? ({ members }) => members : heats));
    }
    this.redraw();
  }

  // The answers that have a heat map: found ones and weak matches.
  hot() {
    const { strength } = this.meta.picture;
    return this.answers.filter(({ best, verdict }) => best >= 0 && strength[verdict.outcome] > 0);
  }

  // A verdict for the panel.
  said(answer) {
    const { outcome, found, margin, probability, byChance } = answer.verdict;
    const { levels, guess } = this.meta.language;
    const share = 100 * Math.max(byChance ?? 0, 0.001); // never 0 %
    const chance = byChance === null ? "" : `, by chance ${share.toFixed(share >= 1 ? 0 : 1)} %`;
    const elsewhere = found || margin < 0 ? "" : " at another level";
    const sure = probability === null ? chance : `, ${Math.round(100 * probability)} %${elsewhere}`;
    const { metres_per_unit: metres, radius } = this.meta;
    const [scale, unit] = metres ? [metres, "\u00a0m"] : [1, ""];
    const digits = Math.min(Math.max(2 - Math.floor(Math.log10(scale * radius)), 2), 20);
    const place = answer.place?.map((length) => (scale * length).toFixed(digits)).join(" ");
    const count = this.boxes(answer).length;
    const places = `${count < MOST_BOXES ? "" : "at least "}${count} ${count > 1 ? "places" : "place"}`;
    const where = `${places}, level ${levels[answer.level]}; at ${place}${unit}`;
    const absent = this.answers.length > 1 ? "" : answer.phrase;
    const detail = outcome === "not here" ? absent : where;
    const said = element("span", "", { className: OUTCOMES[outcome] });
    if (this.answers.length > 1) {
      const colour = this.meta.query_colours[this.hot().indexOf(answer)] ?? [0.5, 0.5, 0.5];
      said.append(element("i", "● "), `${answer.phrase}: `);
      said.firstChild.style.color = `rgb(${colour.map((part) => 255 * part)})`;
    }
    said.append(element("b", outcome + sure), element("small", detail), element("small", guess));
    return said;
  }

  // Draw the colour scale of an answer, up to half of it for a weak match, with a tick at the threshold.
  legend({ heat, verdict, ...answer }) {
    const [low, high] = byId("legend").querySelectorAll("span");
    [low.textContent, high.textContent] = heat.map((relevancy) => relevancy.toFixed(2));
    const map = byId("legend").querySelector("canvas").getContext("2d");
    const first = 768 * byId("map").selectedIndex;
    const row = map.createImageData(256, 1);
    for (let i = 0; i < 256; ++i) {
      const at = first + 3 * Math.trunc(i * this.meta.picture.strength[verdict.outcome]);
      row.data.set([...this.meta.maps.subarray(at, at + 3), 255], 4 * i);
    }
    map.putImageData(row, 0, 0);
    const tick = Math.round((255 * (this.language.cut(answer) - heat[0])) / (heat[1] - heat[0]));
    map.fillStyle = "#fff";
    map.fillRect(Math.min(Math.max(tick, 0), 254), 0, 2, 1);
  }

  // Settings of the composing shader, as in display/displays.py: a weak match is half as hot. Without a heat map
  // colours are shown.
  appearance() {
    const { display } = this;
    const { picture } = this.meta;
    const hot = this.hot();
    const ranges = hot.map(({ heat, verdict }) => {
      const ends = byId("heat").value === "everywhere" ? heat.map((end) => -end) : [picture.heat_base, 1];
      const [low, high] = display === "segmentation" ? [0, 1] : ends;
      return [low, low + (high - low) / picture.strength[verdict.outcome]];
    });
    return {
      display: hot.length || !OF_ANSWERS.includes(display) ? display : "rgb",
      map: byId("map").selectedIndex,
      own: hot.length > 1,
      ranges: [...ranges, ...Array(3 - ranges.length).fill([0.5, 1])],
    };
  }

  // Corners of the boxes of an answer, the best first: one for each whole that is or contains a member.
  boxes(answer) {
    if (answer.verdict.outcome === "not here") {
      return [];
    }
    const { sizes } = this.language.regions;
    const solid = answer.inside.filter((region) => sizes[region] >= this.meta.language.rule.smallest);
    const regions = solid.length ? solid : answer.inside;
    const byFit = regions.toSorted((a, b) => answer.regionFits[b] - answer.regionFits[a]);
    const things = Map.groupBy(byFit, (region) => wholeOf(this.language.regions, region));
    const { corners } = this.language.tensors;
    const shown = [...things].slice(0, MOST_BOXES).map(([whole, own]) => (own.length > 1 ? whole : own[0]));
    return shown.map((region) => corners.subarray(24 * region, 24 * region + 24));
  }

  view(number) {
    const { views } = this.meta;
    this.current = (number + views.length) % views.length;
    byId("views").value = this.current;
    this.controls.go(views[this.current]);
    this.remember(true);
  }

  moved() {
    this.moving = true;
    this.redraw();
  }

  redraw() {
    if (this.asked || !this.controls.view || this.headset.session) {
      return;
    }
    this.asked = requestAnimationFrame(() => {
      this.asked = 0;
      const began = performance.now();
      this.paint();
      const early = this.moving && this.controls.moving === 1 && !location.hash; // the still shows more
      byId("still").hidden ||= Boolean(this.painter.drawn) && !early;
      if (this.moving) {
        this.keepUp(began);
      }
    });
  }

  paint(print = false) {
    const camera = this.controls.camera(devicePixelRatio * this.share);
    this.painter.sort(camera, this.coarse);
    this.painter.paint(camera, this.appearance());
    this.draw(print);
  }

  // Save the image with its overlays as a PNG.
  async save() {
    const image = element("canvas");
    const scene = byId("scene");
    Object.assign(this, { share: 1, coarse: false });
    await this.painter.sort(this.controls.camera(devicePixelRatio));
    this.paint();
    Object.assign(image, { width: scene.width, height: scene.height });
    for (const layer of [scene, byId("marks")].filter(({ hidden }) => !hidden)) {
      image.getContext("2d").drawImage(layer, 0, 0, image.width, image.height);
    }
    image.toBlob((blob) => {
      const href = URL.createObjectURL(blob);
      element("a", "", { href, download: `${this.meta.title}.png` }).click();
      URL.revokeObjectURL(href);
    });
  }

  // Reduce the resolution after a slow frame, and draw only large Gaussians after a very slow one. Both end when no
  // frame was requested for `REST`, or for twice as long as the last frame took.
  keepUp(began) {
    this.painter.pixels({ width: 1, height: 1 }); // waits for the image
    const taken = performance.now() - began;
    if (taken > SLOW) {
      this.share = Math.max(this.share * Math.sqrt(SLOW / taken), COARSEST);
      this.coarse ||= taken > 4 * SLOW;
    }
    clearTimeout(this.rest);
    const finish = () => {
      Object.assign(this, { share: 1, coarse: false, moving: false });
      this.remember(false);
      this.redraw();
    };
    this.rest = setTimeout(finish, Math.max(REST, 2 * taken));
  }

  // Draw notes and boxes over the image, in pixels of the screen.
  draw(print) {
    const canvas = byId("marks");
    const { notes } = this.meta;
    canvas.hidden = !(this.shown.length || notes.length) || !byId("boxes").checked;
    if (canvas.hidden) {
      return;
    }
    const dots = devicePixelRatio;
    const camera = this.controls.camera(dots);
    const { width, height } = camera;
    Object.assign(canvas, { width, height }); // which clears it
    const context = canvas.getContext("2d");
    if (print) {
      context.drawImage(byId("scene"), 0, 0, width, height); // transparent pixels are printed white
    }
    const marks = [
      ...this.shown.map(({ corners, name }) => [name, cornersOf(corners)]),
      ...notes.map(({ text, at }) => [text, [at]]),
    ].map(([name, points]) => ({ name, seen: points.map((point) => project(camera, point)) }));
    const ahead = marks.filter(({ seen }) => seen.every(([, , z]) => z >= this.meta.raster.near));
    for (const { name, seen } of ahead.filter(({ seen }) => seen.length > 1)) {
      context.beginPath();
      for (const [a, b] of EDGES) {
        context.moveTo(seen[a][0], seen[a][1]);
        context.lineTo(seen[b][0], seen[b][1]);
      }
      for (const [width, colour] of [
        [3.5, "#0009"],
        [1.5, name ? "#ffffff" : "#ffffffb3"],
      ]) {
        Object.assign(context, { lineWidth: width * dots, strokeStyle: colour });
        context.stroke();
      }
    }
    for (const { name, seen } of ahead.filter(({ name }) => name)) {
      this.tag(context, name, seen, dots);
    }
  }

  tag(context, text, seen, dots) {
    const { width, height } = context.canvas;
    const [x, y] = seen.reduce((top, point) => (point[1] < top[1] ? point : top));
    context.font = `600 ${13 * dots}px system-ui, "DejaVu Sans", sans-serif`;
    const shown = text.length > 40 ? `${text.slice(0, 39)}…` : text;
    const wide = context.measureText(shown).width + 14 * dots;
    const inside = seen.some(([x, y]) => x >= 0 && x < width && y >= 0 && y < height); // then all of the tag is
    const left = inside ? Math.max(Math.min(x - wide / 2, width - wide), 0) : x - wide / 2;
    const top = inside ? Math.max(y - 30 * dots, 0) : y - 30 * dots;
    context.fillStyle = "#10141ce6";
    context.beginPath();
    context.roundRect(left, top, wide, 22 * dots, 6 * dots);
    context.fill();
    context.fillStyle = "#ffb454";
    context.fillText(shown, left + 7 * dots, top + 15.5 * dots);
  }
}

// For scripts: `await langsplat` has `ask(phrase, level)`, an answer that is not shown, and `image(camera, display,
// phrase)`, the bytes of an image of that camera's size, drawn when its Gaussians are sorted.
globalThis.langsplat = (async () => {
  const { tensors, meta } = await readPage(byId("data").textContent, (share) => {
    byId("loading").textContent = `Unpacking the scene: ${Math.round(100 * share)} %`;
  });
  byId("data").remove();
  meta.maps = tensors.colour_maps.values;
  const page = new Page(meta, tensors);
  byId("welcome").remove();
  const image = async (camera, display = "rgb", phrase = "") => {
    Object.assign(page, { display, phrase, level: "auto" });
    if (page.language) {
      page.ask();
    }
    let sorted = false;
    while (!sorted) {
      sorted = await page.painter.sort(camera); // false if a later sort for the page's own camera replaced it
    }
    page.painter.paint(camera, page.appearance());
    return page.painter.pixels();
  };
  return { page, image, ask: (phrase, level) => page.language.answers(phrase, level, page.controls.view)[0] };
})();
globalThis.langsplat.catch((error) => {
  byId("loading").textContent = error.message;
  byId("welcome").className += " failed";
  throw error;
});
