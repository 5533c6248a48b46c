// The one websocket of the page: names the runs that are watched, receives their changes, and reconnects when it is cut off.
import { useEffect, useState } from "./html.js";

const VERSION = 1;
const FIRST_WAIT_MS = 500;
const LONGEST_WAIT_MS = 8000;

/** @typedef {{ type: string, run?: string, [field: string]: any }} Message */
/** @typedef {(message: Message) => void} Listener */

class Channel {
  constructor() {
    /** @type {Map<Listener, { run: string, place: () => { since: number | null, revision: number | null } }>} */
    this.watches = new Map();
    /** @type {Set<(state: string) => void>} */
    this.stateListeners = new Set();
    /** @type {WebSocket | null} */
    this.socket = null;
    this.state = "connecting";
    this.hasPlay = false;
    this.wait = FIRST_WAIT_MS;
    /** @type {Map<string, { resolve: (reply: Message) => void, reject: (error: Error) => void, progress?: Listener }>} */
    this.requests = new Map();
    /** @type {Map<number, { frame: (bytes: ArrayBuffer) => void, end: Listener }>} */
    this.sessions = new Map();
    this.nextRequest = 1;
  }

  connect() {
    const address = new URL("channel", location.href);
    address.protocol = address.protocol.replace("http", "ws");
    address.hash = address.search = "";
    const socket = new WebSocket(address);
    socket.binaryType = "arraybuffer";
    this.socket = socket;
    socket.onopen = () => {
      this.wait = FIRST_WAIT_MS;
      this.send({ type: "hello", version: VERSION });
      for (const { run, place } of this.watches.values()) this.send({ type: "watch", run, ...place() });
      this.#setState("connected");
    };
    socket.onmessage = ({ data }) => {
      if (data instanceof ArrayBuffer) this.sessions.get(new DataView(data).getUint16(2, true))?.frame(data);
      else this.#onMessage(JSON.parse(data));
    };
    socket.onclose = () => {
      this.#setState("disconnected");
      this.#lose();
      setTimeout(() => this.connect(), this.wait);
      this.wait = Math.min(2 * this.wait, LONGEST_WAIT_MS);
    };
  }

  /** @param {Message} message */
  send(message) {
    if (this.socket?.readyState === WebSocket.OPEN) this.socket.send(JSON.stringify(message));
  }

  /**
   * Watches a run until the returned function is called. `place`: rows that the page has already.
   * @param {string} run
   * @param {() => { since: number | null, revision: number | null }} place
   * @param {Listener} listener
   */
  watch(run, place, listener) {
    this.watches.set(listener, { run, place });
    this.send({ type: "watch", run, ...place() });
    return () => {
      this.watches.delete(listener);
      if (![...this.watches.values()].some((watch) => watch.run === run)) this.send({ type: "unwatch", run });
    };
  }

  /**
   * A request to the engine worker (docs/play_protocol.md); rejected with an error of one line.
   * @param {string} type @param {Record<string, any>} fields @param {Listener} [progress] @param {(id: string) => void} [started]
   * @returns {Promise<Message>}
   */
  request(type, fields, progress, started) {
    if (this.state === "connecting") return this.#firstState().then(() => this.request(type, fields, progress, started));
    const id = String(this.nextRequest++);
    return new Promise((resolve, reject) => {
      if (this.socket?.readyState !== WebSocket.OPEN) {
        reject(new Error("the server is not connected"));
        return;
      }
      this.requests.set(id, { resolve, reject, progress });
      started?.(id);
      this.send({ type, id, ...fields });
    });
  }

  /** Resolves when the page is connected for the first time, or cannot be. @returns {Promise<void>} */
  #firstState() {
    return new Promise((resolve) => {
      const onState = () => {
        this.stateListeners.delete(onState);
        resolve();
      };
      this.stateListeners.add(onState);
    });
  }

  /** Fails requests and sessions, which are lost with the connection. */
  #lose() {
    const lost = "the connection to the server was lost";
    for (const { reject } of this.requests.values()) reject(new Error(lost));
    for (const { end } of this.sessions.values()) end({ type: "error", text: lost });
    this.requests.clear();
    this.sessions.clear();
  }

  /** @param {Message} message */
  #onMessage(message) {
    if (message.type === "hello") this.hasPlay = message.play;
    const request = this.requests.get(message.id);
    if (request) {
      if (message.type === "progress") request.progress?.(message);
      else this.requests.delete(message.id);
      if (message.type === "reply") request.resolve(message);
      if (message.type === "error") request.reject(Object.assign(new Error(message.text), { code: message.code }));
      return;
    }
    if (message.session !== undefined) {
      this.sessions.get(message.session)?.end(message);
      return;
    }
    if (message.type === "error") console.warn(message.text);
    for (const [listener, { run }] of [...this.watches]) if (message.run === run) listener(message);
  }

  /** @param {string} state */
  #setState(state) {
    this.state = state;
    for (const listener of this.stateListeners) listener(state);
  }
}

export const channel = new Channel();

/** "connecting", "connected" or "disconnected". */
export function useConnection() {
  const [state, set] = useState(channel.state);
  useEffect(() => {
    channel.stateListeners.add(set);
    set(channel.state);
    return () => void channel.stateListeners.delete(set);
  }, []);
  return state;
}
