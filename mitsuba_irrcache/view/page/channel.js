// The connection of the components on this page to the viewer; see view/channel.py.
"use strict";

// Viser's canvas shows arrows and edges only, over the image. Browsers without a graphics processor
// would take most of a frame to clear it, and viser lowers its resolution where frames are slow.
{
  const address = new URL(window.location.href);
  if (!address.searchParams.has("fixedDpr")) {
    const context = document.createElement("canvas").getContext("webgl2");
    const named = context && context.getExtension("WEBGL_debug_renderer_info");
    const name = named ? context.getParameter(named.UNMASKED_RENDERER_WEBGL) : "";
    if (context) context.getExtension("WEBGL_lose_context")?.loseContext();
    const slow = /swiftshader|llvmpipe|software|basic render/i.test(name);
    address.searchParams.set("fixedDpr", slow ? "0.5" : String(Math.min(window.devicePixelRatio, 2)));
    window.history.replaceState(null, "", address);
  }
}

const irrcache = (() => {
  const receivers = new Map(), newest = new Map();
  // Seconds without any message after which the page says so; the viewer sends one every two seconds.
  const SILENCE = 8;
  let socket = null, key = null, closed = false, told = 0, heard = 0, silent = false;

  function connect() {
    const address = new URL("irrcache", window.location.href);
    address.protocol = address.protocol.replace("http", "ws");
    address.search = window.location.search;
    socket = new WebSocket(address);
    socket.binaryType = "arraybuffer";
    socket.onopen = () => {
      if (key) introduce();
      if (closed) deliver("connection", "");
      closed = false;
    };
    socket.onmessage = (event) => {
      heard = performance.now();
      if (silent) deliver("connection", "");
      silent = false;
      if (typeof event.data === "string") {
        const message = JSON.parse(event.data);
        deliver(message.kind, message.value);
        return;
      }
      const bytes = new Uint8Array(event.data), end = bytes.indexOf(0);
      const kind = new TextDecoder().decode(bytes.subarray(0, end));
      deliver(kind, bytes.subarray(end + 1));
    };
    socket.onclose = () => {
      closed = true;
      deliver("connection", "The viewer has ended, or cannot be reached.");
      window.setTimeout(connect, 1500);
    };
  }

  function deliver(kind, value) {
    newest.set(kind, value);
    for (const receive of receivers.get(kind) || []) receive(value);
  }

  /** Send a message; return whether that was possible. */
  function send(kind, value) {
    if (!socket || socket.readyState !== WebSocket.OPEN) return false;
    socket.send(JSON.stringify({ kind, value }));
    return true;
  }

  /** Tell the viewer which of its windows this page is. */
  function introduce() {
    if (send("window", key)) told += 1;
  }

  /** Call a function with the values of a kind of message, the newest one included. */
  function receive(kind, receiver) {
    if (!receivers.has(kind)) receivers.set(kind, new Set());
    receivers.get(kind).add(receiver);
    if (newest.has(kind)) receiver(newest.get(kind));
    return () => receivers.get(kind).delete(receiver);
  }

  /** Return a function that sends the newest of its values at most every few milliseconds. */
  function throttled(kind, milliseconds = 60) {
    let waiting = null, timer = 0;
    return (value) => {
      waiting = [value];
      if (timer) return;
      const flush = () => {
        timer = 0;
        if (!waiting) return;
        send(kind, waiting[0]);
        waiting = null;
        timer = window.setTimeout(flush, milliseconds);
      };
      flush();
    };
  }

  customElements.define("irrcache-window", class extends HTMLElement {
    connectedCallback() {
      key = this.getAttribute("key");
      introduce();
    }
  });

  window.setInterval(() => {
    if (closed || !heard) return;
    const seconds = Math.round((performance.now() - heard) / 1000);
    if (seconds < SILENCE) return;
    silent = true;
    deliver("connection", `The viewer has not responded for ${seconds} seconds.`);
  }, 1000);

  connect();
  // How often the page has introduced itself: after each time, the viewer needs its size.
  return { send, receive, throttled, connections: () => told };
})();
