// The line protocol of docs/adapters.md: one request, one reply, one line each.

import { spawn } from "node:child_process";
import { Wrong } from "./vectors.mjs";

const SILENCE = 10_000; // milliseconds after which a program counts as hanging
const GRACE = 500; // milliseconds that a program has to end by itself
const LONGEST_LINE = 1 << 20;

/** The device did what is not allowed. */
export class Fault extends Error {}

/** The device ended, is silent or talks rubbish; the next reset starts it again. */
export class Death extends Fault {}

export class Device {
  constructor([program, ...words]) { Object.assign(this, { program, words, child: null }); }

  start() {
    let child;
    try {
      child = spawn(this.program, this.words);
    } catch (error) {
      throw new Wrong(`cannot start ${JSON.stringify(this.program)}: ${error.code}`);
    }
    Object.assign(this, { child, got: "", said: "", answer: null });
    const ifOurs = (act) => (...said) => { if (this.child === child) act(...said); };
    child.on("error", ifOurs((error) => this.die(`it cannot be started: ${error.code}`)));
    child.on("close", ifOurs((status, signal) => this.die(`it ended: ${signal ?? `exit status ${status}`}`)));
    child.stdin.on("error", () => {}); // "close" tells it
    child.stderr.setEncoding("utf8").on("data", ifOurs((data) => { this.said = (this.said + data).slice(-2000); }));
    child.stdout.setEncoding("utf8").on("data", ifOurs((data) => this.hear(data)));
  }

  hear(data) {
    this.got += data;
    const end = this.got.indexOf("\n");
    if (!this.answer || (end >= 0 && end + 1 < this.got.length)) return this.die("it talks unasked");
    if (this.got.length > LONGEST_LINE) return this.die("its line is too long");
    if (end < 0) return;
    const { resolve } = this.finished();
    resolve(this.got);
    this.got = "";
  }

  finished() {
    const answer = this.answer;
    this.answer = null;
    if (answer) clearTimeout(answer.timer);
    return answer;
  }

  die(how) {
    const last = this.said.trim().split("\n").at(-1);
    this.obituary = last ? `${how}; it said: ${last.slice(-200)}` : how;
    this.child?.kill("SIGKILL");
    this.child = null;
    this.finished()?.reject(new Death(this.obituary));
  }

  async ask(request, microseconds = 0) {
    if (!this.child) throw new Death(this.obituary);
    const line = await new Promise((resolve, reject) => {
      const timer = setTimeout(() => this.die("it is silent"), SILENCE + microseconds / 1000);
      this.answer = { resolve, reject, timer };
      this.child.stdin.write(`${JSON.stringify(request)}\n`);
    });
    let reply = null;
    try { reply = JSON.parse(line); } catch { /* no reply, as the next lines find out */ }
    if (reply?.ok === false && typeof reply.error === "string") throw new Wrong(`${this.program} says: ${reply.error}`);
    if (reply?.ok !== true) this.rubbish(line);
    return reply;
  }

  rubbish(line) {
    this.die(`it talks rubbish: ${JSON.stringify(line).slice(0, 60)}`);
    throw new Death(this.obituary);
  }

  /** Starts the device, and gives what it says of itself. */
  async describe() {
    this.start();
    try {
      const { description } = await this.ask({ op: "describe" });
      if (!Array.isArray(description?.locals ?? [])) this.rubbish(JSON.stringify(description));
      return { real: !description?.virtual_time, locals: new Set(description?.locals) };
    } catch (error) {
      throw error instanceof Death ? new Wrong(`${this.program} is no device: ${error.message}`) : error;
    }
  }

  /** Power cycles it; a dead one is started again. */
  async reset() {
    if (!this.child) this.start();
    await this.ask({ op: "reset" });
  }

  /** Gives the bytes, or null where the working counter is 0. */
  async read(address, length) {
    const { wkc, data } = await this.ask({ op: "read", address, length });
    if (!this.counter(wkc)) return null;
    if (typeof data !== "string" || data.length !== 2 * length) this.rubbish(`data ${data}`);
    return Buffer.from(data, "hex");
  }

  /** Gives the working counter, 0 or 1. */
  async write(address, data) {
    return this.counter((await this.ask({ op: "write", address, data: data.toString("hex") })).wkc);
  }

  counter(wkc) {
    if (!Number.isInteger(wkc) || wkc < 0) this.rubbish(`working counter ${wkc}`);
    return Math.min(1, wkc);
  }

  async advance(us) { await this.ask({ op: "advance", seconds: us / 1e6 }, us); }

  async local(event) { await this.ask({ op: "local", event }); }

  close() {
    const { child } = this;
    this.child = null;
    if (!child) return;
    child.stdin.end();
    setTimeout(() => child.kill("SIGKILL"), GRACE).unref();
  }
}
