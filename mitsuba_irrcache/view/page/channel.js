// The connection of the components on this page to the viewer; see view/channel.py.
"use strict";

// Viser lowers its resolution where frames are slow, and images at rest stayed coarse.
{
  const address = new URL(window.location.href);
  if (!address.searchParams.has("fixedDpr")) {
    address.searchParams.set("fixedDpr", String(Math.min(window.devicePixelRatio || 1, 2)));
    window.history.replaceState(null, "", address);
  }
}

const irrcache = (() => {
  const receivers = new Map(), newest = new Map();
  let socket = null, key = null, closed = false;

  function connect() {
    const address = new URL("irrcache", window.location.href);
    address.protocol = address.protocol.replace("http", "ws");
    address.search = window.location.search;
    socket = new WebSocket(address);
    socket.binaryType = "arraybuffer";
    socket.onopen = () => {
      if (key) send("window", key);
      if (closed) deliver("connection", "");
      closed = false;
    };
    socket.onmessage = (event) => {
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

  function send(kind, value) {
    if (socket && socket.readyState === WebSocket.OPEN) socket.send(JSON.stringify({ kind, value }));
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

  // Tells the viewer which of its windows this page is.
  customElements.define("irrcache-window", class extends HTMLElement {
    connectedCallback() {
      key = this.getAttribute("key");
      send("window", key);
    }
  });

  connect();
  return { send, receive, throttled };
})();
