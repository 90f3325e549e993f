// What lies over the image: messages, captions, orientation marker, and the comparison.
//
// Messages of the viewer: "wait" (text before the first image), "note" (of the image), "status" (of
// the caches), "camera" (rows right, up, forward), "axes" (labels), "comparison" (mode and
// captions), "reference" (a JPEG), "picture" (the image, which lies behind viser's canvas); see
// view/visitor.py and view/panel.py.
"use strict";

(() => {
  const CORNER = 34;
  const PANEL = 324; // width of viser's panel, before it is there
  const CLIENT_DELAY = 3000; // ms after which viser's client starts even if there is no image yet
  const picture = Object.assign(document.createElement("canvas"), { id: "irrcache-picture" });
  let size = [], connection = 0, pictures = 0, displayed = 0;
  let root, split = 0.5, comparison = { mode: "off" }, shown = null;
  const find = (name) => root.querySelector(`[data-id="${name}"]`);
  const set = (name, text) => {
    const part = find(name);
    if (part.textContent !== text) part.textContent = text;
    part.hidden = !text;
  };

  function build() {
    root = document.createElement("div");
    root.id = "irrcache-overlay";
    root.innerHTML = `
      <img class="preview" data-id="preview" alt="" hidden>
      <img data-id="reference" alt="image by volpath" hidden>
      <div class="pending" data-id="pending" hidden></div>
      <div class="divider" data-id="divider" role="slider" tabindex="0" hidden
        aria-label="divider between irrcache and volpath" aria-valuemin="0" aria-valuemax="100"
        ><span>↔</span></div>
      <div class="caption left" data-id="left" hidden></div>
      <div class="caption right" data-id="right" hidden></div>
      <div class="scale" data-id="scale" hidden><span data-id="low"></span><canvas></canvas
        ><span data-id="high"></span></div>
      <svg class="axes" data-id="axes" viewBox="-50 -50 100 100" role="img"
        aria-label="orientation of the axes"></svg>
      <div class="note" data-id="note" hidden></div>
      <div class="hint" data-id="hint" hidden></div>
      <div class="message" data-id="message"></div>`;
    document.body.appendChild(root);
    find("divider").addEventListener("pointerdown", grab);
    find("divider").addEventListener("keydown", (event) => {
      const step = { ArrowLeft: -0.02, ArrowRight: 0.02 }[event.key];
      if (step) place(split + step);
    });
  }

  /** Keep the overlay over viser's canvas, which the panel beside it makes smaller, the image behind
   * it, and the viewer informed of its size in pixels of the screen. */
  function follow() {
    const canvas = document.querySelector("#root canvas[data-engine]") || document.querySelector("#root canvas");
    if (canvas && picture.parentElement !== canvas.parentElement) canvas.parentElement.prepend(picture);
    if (canvas) tellSize(canvas);
    const box = canvas ? canvas.getBoundingClientRect()
      : { left: 0, top: 0, width: window.innerWidth - PANEL, height: window.innerHeight };
    for (const side of ["left", "top", "width", "height"]) root.style[side] = `${box[side]}px`;
    window.setTimeout(follow, canvas ? 250 : 50);
  }

  function tellSize(canvas) {
    const ratio = Math.min(window.devicePixelRatio, 2);
    const now = [canvas.clientWidth, canvas.clientHeight].map((n) => Math.round(n * ratio));
    if (now.join() === size.join() && connection === irrcache.connections()) return;
    if (!irrcache.send("size", now)) return;
    size = now;
    connection = irrcache.connections();
  }

  /** Show an image that the viewer has rendered; JPEG, or PNG if none will follow. */
  async function show(bytes) {
    const number = ++pictures, isFinal = bytes[0] === 0x89;
    const type = isFinal ? "image/png" : "image/jpeg";
    const image = await createImageBitmap(new Blob([bytes], { type })).catch(() => null);
    if (!image || number < displayed) return; // a newer one was decoded earlier
    displayed = number;
    [picture.width, picture.height] = [image.width, image.height];
    picture.getContext("bitmaprenderer").transferFromImageBitmap(image);
    find("preview").hidden = true;
    const detail = { width: picture.width, height: picture.height, final: isFinal };
    window.dispatchEvent(new CustomEvent("irrcache-picture", { detail }));
  }

  function grab(event) {
    const divider = find("divider");
    divider.setPointerCapture(event.pointerId);
    const move = (e) => {
      const box = root.getBoundingClientRect();
      place((e.clientX - box.left) / box.width);
    };
    const end = () => {
      divider.removeEventListener("pointermove", move);
      divider.removeEventListener("pointerup", end);
      divider.removeEventListener("pointercancel", end);
    };
    divider.addEventListener("pointermove", move);
    divider.addEventListener("pointerup", end);
    divider.addEventListener("pointercancel", end);
    event.preventDefault();
  }

  function place(share) {
    split = Math.min(Math.max(share, 0), 1);
    find("divider").style.left = `${100 * split}%`;
    find("divider").setAttribute("aria-valuenow", String(Math.round(100 * split)));
    for (const name of ["reference", "pending"]) {
      find(name).style.clipPath = `inset(0 0 0 ${100 * split}%)`;
    }
  }

  function compare(value) {
    comparison = value;
    const swipe = value.mode === "swipe";
    find("divider").hidden = !swipe;
    find("pending").hidden = !swipe || value.has_image; // what is below is no image by volpath
    set("left", value.left || "");
    set("right", value.right || "");
    if (!swipe || !value.has_image) hideReference();
    find("scale").hidden = !value.scale;
    if (!value.scale) return;
    set("low", value.scale.low);
    set("high", value.scale.high);
    const bar = find("scale").querySelector("canvas"), colours = value.scale.colours;
    bar.width = colours.length;
    bar.height = 1;
    colours.forEach(([r, g, b], i) => {
      bar.getContext("2d").fillStyle = `rgb(${r},${g},${b})`;
      bar.getContext("2d").fillRect(i, 0, 1, 1);
    });
  }

  function hideReference() {
    find("reference").hidden = true;
    const former = shown;
    if (former) window.setTimeout(() => URL.revokeObjectURL(former), 2000); // it may be loading
    shown = null;
  }

  async function showReference(bytes) {
    if (comparison.mode !== "swipe") return;
    const url = URL.createObjectURL(new Blob([bytes], { type: "image/jpeg" }));
    const image = find("reference"), former = shown;
    shown = url;
    image.src = url;
    await image.decode().catch(() => {});
    if (shown === url) image.hidden = false;
    if (former) URL.revokeObjectURL(former);
  }

  /** Show an image until the first one for this window arrives; windows that open later have none. */
  function preview(bytes) {
    const image = find("preview");
    if (!bytes.length || !find("note").hidden) return startClient();
    image.hidden = false;
    image.onload = image.onerror = () => {
      URL.revokeObjectURL(image.src);
      window.requestAnimationFrame(startClient); // once the image is visible
    };
    image.src = URL.createObjectURL(new Blob([bytes], { type: "image/jpeg" }));
  }

  /** Start viser's client unless that has been done; see web_page.py. */
  function startClient() {
    const script = document.querySelector('script[type="text/viser"]');
    if (!script) return;
    const copy = document.createElement("script");
    Object.assign(copy.dataset, script.dataset);
    copy.textContent = script.textContent;
    script.replaceWith(copy);
  }

  /** Draw the axes of the scene as the camera sees them, those behind first. */
  function axes(rows, labels) {
    const colours = ["#ff6b6b", "#69db7c", "#74a9ff"];
    const arrows = [0, 1, 2].map((i) => ({
      i, x: CORNER * rows[0][i], y: -CORNER * rows[1][i], depth: rows[2][i],
    })).sort((a, b) => b.depth - a.depth);
    find("axes").innerHTML = arrows.map(({ i, x, y, depth }) => `
      <line x1="0" y1="0" x2="${x}" y2="${y}" stroke="${colours[i]}" stroke-width="3"
        opacity="${depth > 0.15 ? 0.5 : 1}"/>
      <text x="${1.3 * x}" y="${1.3 * y}" fill="${colours[i]}" font-size="12"
        text-anchor="middle" dominant-baseline="central"></text>`).join("");
    find("axes").querySelectorAll("text").forEach((text, n) => (text.textContent = labels[arrows[n].i]));
  }

  function start() {
    build();
    follow();
    place(0.5);
    let rows = null, labels = ["x", "y", "z"], waiting = "connecting to the viewer ...", lost = "";
    const message = () => set("message", waiting.startsWith("error:") ? waiting : lost || waiting);
    message();
    irrcache.receive("camera", (value) => axes((rows = value), labels));
    irrcache.receive("axes", (value) => { labels = value; if (rows) axes(rows, labels); });
    irrcache.receive("wait", (text) => { waiting = text; message(); });
    irrcache.receive("connection", (text) => { lost = text; message(); });
    irrcache.receive("note", (text) => {
      set("note", text);
      if (text.endsWith("per pixel")) find("preview").hidden = true; // an image, no message
    });
    irrcache.receive("preview", preview);
    window.setTimeout(startClient, CLIENT_DELAY);
    irrcache.receive("picture", show);
    irrcache.receive("hint", (text) => set("hint", text));
    irrcache.receive("comparison", compare);
    irrcache.receive("reference", showReference);
  }

  // A slice of the volume's values, in the panel.
  customElements.define("irrcache-slice", class extends HTMLElement {
    connectedCallback() {
      this.innerHTML = '<img alt="slice of the values">';
      const image = this.querySelector("img");
      let url = null;
      this.stop = irrcache.receive("slice", (bytes) => {
        const former = url;
        if (former) window.setTimeout(() => URL.revokeObjectURL(former), 2000); // it may be loading
        image.src = url = URL.createObjectURL(new Blob([bytes], { type: "image/png" }));
      });
    }
    disconnectedCallback() { this.stop(); }
  });

  if (document.readyState === "loading") document.addEventListener("DOMContentLoaded", start);
  else start();
})();
