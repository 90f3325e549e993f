// Interactive images of the report: zoom, common pan, flip, swipe, exposure, values, errors.
//
// Input: the JSON in <script id="image-data">, written by compare/embedded.py; see `pack` there for
// the encoding of an image. Radiance is kept as half-float codes, so that a change of exposure is
// one table of 65536 entries instead of arithmetic per pixel.
"use strict";

(() => {
  const TONES = {
    sRGB: (v) => v,
    Reinhard: (v) => v / (1 + Math.max(v, 0)),
    filmic: (v) => {
      v = Math.max(v, 0);
      return (v * (2.51 * v + 0.03)) / (v * (2.43 * v + 0.59) + 0.14);
    },
  };
  const srgb = (v) => (v <= 0.0031308 ? 12.92 * v : 1.055 * v ** (1 / 2.4) - 0.055);
  const clamp = (v, low, high) => Math.min(Math.max(v, low), high);

  // The values of all half-float codes.
  const HALF = new Float32Array(65536);
  for (let code = 0; code < 65536; code++) {
    const exponent = (code >> 10) & 31, fraction = code & 1023;
    const size = exponent === 0 ? fraction * 2 ** -24
      : exponent === 31 ? (fraction ? NaN : Infinity)
      : (1 + fraction / 1024) * 2 ** (exponent - 15);
    HALF[code] = code & 32768 ? -size : size;
  }

  /** Return the codes (channel, y, x) of an image: inflate, join the bytes, add up each row. */
  async function unpack(text, width, height, channels) {
    const packed = Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
    const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("deflate"));
    const bytes = new Uint8Array(await new Response(stream).arrayBuffer());
    const count = width * height * channels, codes = new Uint16Array(count);
    for (let i = 0; i < count; i++) {
      const step = bytes[i] | (bytes[count + i] << 8);
      codes[i] = i % width ? codes[i - 1] + step : step;
    }
    return codes;
  }

  class Images {
    constructor(root, data) {
      Object.assign(this, { root, data });
      this.pixels = data.width * data.height;
      this.reference = data.images.length - 1;
      this.a = data.first;
      this.b = this.reference;
      this.split = 0.5;
      this.view = { x: data.width / 2, y: data.height / 2, zoom: 0 }; // zoom 0: fit
      this.tiles = new Map(); // display pixels of an image, by its number
      this.errorTiles = new Map(); // its errors, if these are displayed
      this.find = (name) => root.querySelector(`[data-id="${name}"]`);
      this.canvas = this.find("canvas");
      this.addChoices();
      this.addEvents();
      this.resize();
    }

    async load() {
      for (const image of this.data.images) {
        const { width, height, channels } = this.data;
        image.codes = await unpack(image.data, width, height, channels);
        delete image.data;
      }
      this.find("values").textContent = "move the pointer over an image to read its pixels";
      this.changed();
    }

    // ------------------------------------------------------------------ what is shown

    option(name) {
      const field = this.find(name);
      return field.type === "checkbox" ? field.checked
        : field.type === "range" ? Number(field.value) : field.value;
    }

    /** Return [image, clip from, clip to, left edge, width] of the panes, in CSS pixels. */
    panes() {
      const width = this.width;
      const trivial = this.b === this.reference && this.option("quantity") !== "radiance";
      const layout = trivial ? "one" : this.option("layout"); // the reference has no error
      if (layout === "swipe") {
        const at = this.split * width;
        return [[this.a, 0, at, 0, width], [this.b, at, width, 0, width]];
      }
      if (layout === "side by side") {
        const half = width / 2;
        return [[this.a, 0, half - 1, 0, half], [this.b, half + 1, width, half, half]];
      }
      return [[this.a, 0, width, 0, width]];
    }

    scale(pane) {
      const { width, height } = this.data;
      const fit = Math.min(pane[4] / width, this.height / height);
      return fit * 2 ** (this.view.zoom / 4);
    }

    changed() {
      this.tiles.clear();
      this.errorTiles.clear();
      this.readOut();
      this.draw();
    }

    /** Return a canvas with the display pixels of an image. */
    tile(number) {
      if (!this.tiles.has(number)) {
        const canvas = document.createElement("canvas");
        canvas.width = this.data.width;
        canvas.height = this.data.height;
        const context = canvas.getContext("2d");
        const pixels = context.createImageData(canvas.width, canvas.height);
        const quantity = this.option("quantity");
        if (quantity === "radiance") this.paintRadiance(number, pixels.data);
        else this.paintError(number, pixels.data, quantity);
        context.putImageData(pixels, 0, 0);
        this.tiles.set(number, canvas);
      }
      return this.tiles.get(number);
    }

    paintRadiance(number, target) {
      const tone = TONES[this.option("tone")], gain = 2 ** this.option("exposure");
      const table = new Uint8Array(65536);
      for (let code = 0; code < 65536; code++) {
        const v = tone(HALF[code] * gain);
        table[code] = v > 0 ? Math.round(255 * srgb(Math.min(v, 1))) : 0; // NaN is black
      }
      const { codes } = this.data.images[number], { channels } = this.data;
      const offsets = [0, 1, 2].map((c) => (channels === 3 ? c * this.pixels : 0));
      for (let i = 0; i < this.pixels; i++) {
        for (let c = 0; c < 3; c++) target[4 * i + c] = table[codes[offsets[c] + i]];
        target[4 * i + 3] = 255;
      }
    }

    paintError(number, target, quantity) {
      const errors = this.errors(number, quantity), limit = this.limit();
      this.errorTiles.set(number, errors);
      const signed = quantity === "signed error";
      const colours = this.data.colours[signed ? "signed" : "size"], last = colours.length - 1;
      for (let i = 0; i < this.pixels; i++) {
        const at = signed ? 0.5 + (0.5 * errors[i]) / limit : errors[i] / limit;
        const colour = colours[Math.round(clamp(at || 0, 0, 1) * last)];
        for (let c = 0; c < 3; c++) target[4 * i + c] = colour[c];
        target[4 * i + 3] = 255;
      }
    }

    limit() { return 10 ** this.option("limit"); }

    /** Return the errors of all pixels in percent: means over the channels, and over blocks. */
    errors(number, quantity) {
      const { channels, width } = this.data, errors = new Float32Array(this.pixels);
      const ours = this.data.images[number].codes, truth = this.data.images[this.reference].codes;
      const floor = 0.01 * this.data.mean;
      for (let i = 0; i < this.pixels; i++) {
        let difference = 0, radiance = 0;
        for (let c = 0; c < channels; c++) {
          const right = HALF[truth[c * this.pixels + i]];
          difference += (HALF[ours[c * this.pixels + i]] || 0) - right;
          radiance += right;
        }
        errors[i] = (100 * difference) / channels;
        errors[i] /= quantity === "relative error" ? Math.abs(radiance / channels) + floor
          : this.data.mean;
      }
      if (this.option("blocks")) averageBlocks(errors, width, this.data.height, 8);
      if (quantity === "relative error") errors.forEach((e, i) => (errors[i] = Math.abs(e)));
      return errors;
    }

    // ------------------------------------------------------------------ drawing

    resize() {
      const box = this.root.clientWidth - 20, { width, height } = this.data;
      this.width = Math.max(box, 100);
      this.height = clamp((this.width * height) / width, 120, 0.68 * window.innerHeight);
      const ratio = window.devicePixelRatio || 1;
      this.canvas.width = Math.round(this.width * ratio);
      this.canvas.height = Math.round(this.height * ratio);
      this.canvas.style.height = `${this.height}px`;
      this.draw();
    }

    draw() {
      if (!this.pending) this.pending = requestAnimationFrame(() => this.drawNow());
    }

    drawNow() {
      this.pending = 0;
      if (!this.data.images[this.reference].codes) return;
      const context = this.canvas.getContext("2d");
      context.setTransform(1, 0, 0, 1, 0, 0);
      context.clearRect(0, 0, this.canvas.width, this.canvas.height);
      const ratio = this.canvas.width / this.width;
      context.scale(ratio, ratio);
      const panes = this.panes();
      panes.forEach((pane, index) => this.drawPane(context, pane, index, panes.length));
      if (panes.length === 2 && panes[1][3] === 0) this.drawDivider(context);
      this.drawScale();
      this.markChoices();
    }

    drawPane(context, pane, index, count) {
      const [number, from, to, left, width] = pane, scale = this.scale(pane);
      context.save();
      context.beginPath();
      context.rect(from, 0, Math.max(to - from, 0), this.height);
      context.clip();
      const x = left + width / 2 - this.view.x * scale, y = this.height / 2 - this.view.y * scale;
      context.imageSmoothingEnabled = scale < 1;
      context.drawImage(this.tile(number), x, y, this.data.width * scale, this.data.height * scale);
      if (scale >= 44) this.drawNumbers(context, number, x, y, scale, from, to);
      const name = this.data.images[number].caption;
      context.font = "12px system-ui, sans-serif";
      const wide = context.measureText(name).width + 12, right = index === 1 && count === 2;
      const at = right ? Math.max(to - wide, from) : from;
      context.fillStyle = "#000a";
      context.fillRect(at, 0, wide, 20);
      context.fillStyle = "#fff";
      context.fillText(name, at + 6, 14);
      context.restore();
    }

    /** Write radiance, or else the displayed error in percent, into the pixels in the pane. */
    drawNumbers(context, number, x, y, scale, from, to) {
      const { width, height } = this.data, size = clamp(scale / 5, 9, 14);
      const errors = this.errorTiles.get(number), channels = errors ? 1 : this.data.channels;
      context.font = `${size}px ui-monospace, monospace`;
      context.textAlign = "center";
      const first = [Math.floor((from - x) / scale), Math.floor(-y / scale)].map((v) => Math.max(v, 0));
      const last = [Math.min((to - x) / scale, width - 1), Math.min((this.height - y) / scale, height - 1)];
      for (let row = first[1]; row <= last[1]; row++) {
        for (let column = first[0]; column <= last[0]; column++) {
          const values = errors ? [errors[row * width + column]] : this.values(number, column, row);
          const lines = values.map((v) => v.toPrecision(3) + (errors ? " %" : ""));
          lines.forEach((text, c) => {
            const down = y + (row + 0.5) * scale + (c + 0.85 - channels / 2) * size * 1.05;
            context.strokeStyle = "#000c";
            context.lineWidth = 2.5;
            context.strokeText(text, x + (column + 0.5) * scale, down);
            context.fillStyle = channels === 3 ? ["#ff9d9d", "#a4f5a4", "#a9c4ff"][c] : "#fff";
            context.fillText(text, x + (column + 0.5) * scale, down);
          });
        }
      }
      context.textAlign = "start";
    }

    drawDivider(context) {
      const at = this.split * this.width;
      context.fillStyle = "#fff";
      context.fillRect(at - 1, 0, 2, this.height);
      context.beginPath();
      context.arc(at, this.height / 2, 11, 0, 2 * Math.PI);
      context.fill();
      context.fillStyle = "#333";
      context.font = "13px system-ui, sans-serif";
      context.fillText("↔", at - 7, this.height / 2 + 5);
    }

    drawScale() {
      const quantity = this.option("quantity"), shown = quantity !== "radiance";
      this.find("scale").hidden = this.find("error-controls").hidden = !shown;
      this.find("tone-controls").hidden = shown;
      if (!shown) return;
      const signed = quantity === "signed error", limit = this.limit().toPrecision(2);
      this.find("low").textContent = signed ? `−${+limit} % too dark` : "0 %";
      this.find("high").textContent = signed ? `+${+limit} % too bright` : `${+limit} % and more`;
      const bar = this.find("bar"), colours = this.data.colours[signed ? "signed" : "size"];
      bar.width = colours.length;
      bar.height = 1;
      colours.forEach(([r, g, b], i) => {
        bar.getContext("2d").fillStyle = `rgb(${r},${g},${b})`;
        bar.getContext("2d").fillRect(i, 0, 1, 1);
      });
    }

    // ------------------------------------------------------------------ values

    values(number, x, y) {
      const { codes } = this.data.images[number], found = [];
      for (let c = 0; c < this.data.channels; c++) {
        found.push(HALF[codes[c * this.pixels + y * this.data.width + x]]);
      }
      return found;
    }

    /** Return the pixel [x, y] under the pointer, which may lie outside of the image. */
    pixelAt(event) {
      const box = this.canvas.getBoundingClientRect();
      const left = event.clientX - box.left, top = event.clientY - box.top;
      const pane = this.panes().find((p) => left >= p[1] && left <= p[2]) || this.panes()[0];
      const scale = this.scale(pane);
      return [this.view.x + (left - pane[3] - pane[4] / 2) / scale,
        this.view.y + (top - this.height / 2) / scale, scale, left / this.width];
    }

    readOut() {
      if (!this.pointed || !this.data.images[this.reference].codes) return;
      const [x, y] = this.pointed.map(Math.floor), { width, height, mean } = this.data;
      if (x < 0 || y < 0 || x >= width || y >= height) return;
      const truth = this.values(this.reference, x, y);
      const shown = [...new Set([...this.panes().map((pane) => pane[0]), this.reference])];
      const lines = shown.map((number) => {
        const values = this.values(number, x, y);
        const numbers = values.map((v) => v.toPrecision(4).padStart(10)).join(" ");
        if (number === this.reference) return `${numbers}  reference`;
        const error = values.reduce((sum, v, c) => sum + v - truth[c], 0) / values.length;
        const whole = truth.reduce((sum, v) => sum + v, 0) / values.length;
        const share = whole ? `, ${((100 * error) / whole).toPrecision(3)} % of the pixel` : "";
        const percent = `error ${((100 * error) / mean).toPrecision(3)} % of the mean${share}`;
        return `${numbers}  ${this.data.images[number].caption}; ${percent}`;
      });
      this.find("values").textContent = `pixel ${x}, ${y}\n${lines.join("\n")}`;
    }

    // ------------------------------------------------------------------ controls

    addChoices() {
      const table = this.find("choices");
      const place = (row, image, number) => {
        const button = row.insertCell().appendChild(document.createElement("button"));
        button.textContent = image.label;
        button.title = `${image.caption}. Click: show; Shift and click: compare with it`;
        button.addEventListener("click", (event) => this.choose(number, event.shiftKey));
        image.button = button;
      };
      this.data.rows.forEach((name, index) => {
        const row = table.insertRow();
        row.appendChild(document.createElement("th")).textContent = name;
        this.data.images.forEach((image, n) => image.row === index && place(row, image, n));
      });
    }

    markChoices() {
      this.data.images.forEach((image, number) => {
        image.button.classList.toggle("a", number === this.a);
        const second = number === this.b && this.option("layout") !== "one";
        image.button.classList.toggle("b", second);
      });
    }

    choose(number, second) {
      if (second) this.b = number;
      else {
        if (number !== this.a) this.former = this.a;
        this.a = number;
      }
      this.readOut();
      this.draw();
    }

    addEvents() {
      const canvas = this.canvas;
      for (const name of ["quantity", "tone", "exposure", "limit", "blocks"]) {
        this.find(name).addEventListener("input", () => this.changed());
      }
      this.find("layout").addEventListener("input", () => this.draw());
      this.find("fit").addEventListener("click", () => this.fit());
      this.find("exposure").addEventListener("input", () => this.tellExposure());
      this.tellExposure();
      window.addEventListener("resize", () => this.resize());
      canvas.addEventListener("wheel", (event) => this.wheel(event), { passive: false });
      canvas.addEventListener("pointerdown", (event) => this.press(event));
      canvas.addEventListener("pointermove", (event) => this.move(event));
      canvas.addEventListener("pointerup", () => (this.drag = null));
      canvas.addEventListener("pointercancel", () => (this.drag = null));
      canvas.addEventListener("dblclick", () => this.fit());
      canvas.addEventListener("keydown", (event) => this.key(event));
    }

    tellExposure() {
      const stops = this.option("exposure");
      this.find("stops").textContent = `${stops > 0 ? "+" : ""}${stops} EV`;
    }

    fit() {
      this.view = { x: this.data.width / 2, y: this.data.height / 2, zoom: 0 };
      this.draw();
    }

    wheel(event) {
      event.preventDefault();
      const [x, y, before] = this.pixelAt(event);
      this.view.zoom = clamp(this.view.zoom - Math.sign(event.deltaY), -8, 44);
      const after = this.pixelAt(event)[2], factor = before / after;
      this.view.x = x + (this.view.x - x) * factor; // the pixel under the pointer stays there
      this.view.y = y + (this.view.y - y) * factor;
      this.draw();
    }

    press(event) {
      this.canvas.setPointerCapture(event.pointerId);
      this.canvas.focus({ preventScroll: true });
      const at = this.pixelAt(event)[3];
      const panes = this.panes(), swipe = panes.length === 2 && panes[1][3] === 0;
      const grabs = swipe && Math.abs(at - this.split) * this.width < 12;
      this.drag = { divider: grabs, x: event.clientX, y: event.clientY };
    }

    move(event) {
      const [x, y, scale, at] = this.pixelAt(event);
      this.pointed = [x, y];
      if (this.drag && this.drag.divider) this.split = clamp(at, 0, 1);
      else if (this.drag) {
        this.view.x -= (event.clientX - this.drag.x) / scale;
        this.view.y -= (event.clientY - this.drag.y) / scale;
        Object.assign(this.drag, { x: event.clientX, y: event.clientY });
      }
      this.readOut();
      if (this.drag) this.draw();
    }

    key(event) {
      if (event.ctrlKey || event.metaKey || event.altKey) return;
      const step = (by) => this.choose(clamp(this.a + by, 0, this.reference), false);
      const set = (name, value) => {
        this.find(name).value = value;
        this.find(name).dispatchEvent(new Event("input"));
      };
      const toggle = (name, on, off) => set(name, this.option(name) === on ? off : on);
      const actions = {
        ArrowLeft: () => step(-1),
        ArrowRight: () => step(1),
        " ": () => this.choose(this.a === this.b ? (this.former ?? 0) : this.b, false),
        s: () => toggle("layout", "swipe", "one"),
        d: () => toggle("layout", "side by side", "one"),
        e: () => toggle("quantity", "signed error", "radiance"),
        r: () => toggle("quantity", "relative error", "radiance"),
        f: () => this.fit(),
        "+": () => set("exposure", this.option("exposure") + 0.5),
        "-": () => set("exposure", this.option("exposure") - 0.5),
      };
      const digit = Number(event.key);
      if (event.key !== " " && Number.isInteger(digit) && digit >= 1 && digit <= this.reference + 1) {
        this.choose(digit - 1, false);
      } else if (event.key in actions) actions[event.key]();
      else return;
      event.preventDefault();
    }
  }

  function averageBlocks(values, width, height, size) {
    for (let y = 0; y < height; y += size) {
      for (let x = 0; x < width; x += size) {
        const right = Math.min(x + size, width), bottom = Math.min(y + size, height);
        let sum = 0;
        for (let v = y; v < bottom; v++) for (let u = x; u < right; u++) sum += values[v * width + u];
        sum /= (right - x) * (bottom - y);
        for (let v = y; v < bottom; v++) values.fill(sum, v * width + x, v * width + right);
      }
    }
  }

  const source = document.getElementById("image-data");
  if (source) {
    const root = document.querySelector(".images");
    const images = new Images(root, JSON.parse(source.textContent));
    images.load().catch((error) => {
      root.querySelector('[data-id="values"]').textContent =
        `The images could not be decoded (${error.message}). They need a browser with ` +
        "DecompressionStream: Chrome 80, Firefox 113, Safari 16.4 or newer.";
    });
  }
})();
