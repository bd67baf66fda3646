// The WebSocket to the monitor; its protocol is described in server.py.

const RECONNECT_MS = 1000;

export class Link {
  // handlers: hello, state, events, rows(epoch, table), picture(overlay, jpeg), open(bool)
  constructor(handlers) {
    this.handlers = handlers;
    this.calls = new Map();
    this.number = 0;
    this.connect();
  }

  connect() {
    const scheme = location.protocol === "https:" ? "wss" : "ws";
    this.socket = new WebSocket(`${scheme}://${location.host}/live`);
    this.socket.binaryType = "arraybuffer";
    this.socket.onmessage = ({ data }) => typeof data === "string" ? this.onText(data) : this.onBinary(data);
    this.socket.onopen = () => this.handlers.open(true);
    this.socket.onclose = () => {
      for (const answer of this.calls.values()) answer({ success: false, message: "connection lost" });
      this.calls.clear();
      this.handlers.open(false);
      setTimeout(() => this.connect(), RECONNECT_MS);
    };
  }

  onText(data) {
    const message = JSON.parse(data);
    if (message.type === "result") {
      this.calls.get(message.id)?.(message);
      this.calls.delete(message.id);
    } else {
      this.handlers[message.type]?.(message);
    }
  }

  onBinary(data) {
    const [kind, a, b, c] = new Uint32Array(data, 0, 4);
    if (kind === 1) {
      this.handlers.rows(a, { rows: b, columns: c, values: new Float64Array(data, 16) });
    } else if (kind === 2) {
      const overlay = JSON.parse(new TextDecoder().decode(new Uint8Array(data, 16, a)));
      this.handlers.picture(overlay, new Uint8Array(data, 16 + a, b));
    }
  }

  send(message) {
    if (this.socket.readyState === WebSocket.OPEN) this.socket.send(JSON.stringify(message));
  }

  // value: a number for the services that take one
  call(service, value) {
    return new Promise((resolve) => {
      if (this.socket.readyState !== WebSocket.OPEN) {
        resolve({ success: false, message: "not connected" });
        return;
      }
      this.calls.set(++this.number, resolve);
      this.send({ type: "call", id: this.number, service, ...(value === undefined ? {} : { value }) });
    });
  }
}
