// Plays test vectors in JavaScript: from a file, on a program.
//
//     node replay.mjs FILE PROGRAM [ARGUMENT...]
//
// FILE comes from `ecatspec export DEVICE --format json`; docs/vectors.md says what it means, and
// the numbers in comments are those of its section "What a consumer does". PROGRAM speaks the line
// protocol of docs/adapters.md. Exit status: 0 the device conforms, 1 it does not, 2 the file or
// the program is wrong.

import { Death, Device, Fault } from "./device.mjs";
import { Wrong, load } from "./vectors.mjs";

const FIRST_WAIT = 500; // microseconds; each wait for the same is four times the one before
const MOST_MAIL = 64; // messages to take away for one expectation

/** The device went another way that is allowed. */
class End extends Error {}

const bytes = (digits) => Buffer.from(digits, "hex");
const little = (data) => data.reduceRight((sum, each) => sum * 256 + each, 0);
const words = (symbol, anyOf) => {
  const ways = anyOf.slice(0, 3).map(({ value, mask }) => `${value} where ${mask}`);
  if (anyOf.length > ways.length) ways.push(`${anyOf.length - ways.length} more`);
  return [symbol, ...ways].join(" or ").replace(" or ", " ");
};

/** Gives the first entry that the bytes are; what follows them is not compared. */
function find(anyOf, data) {
  return anyOf.find(({ value, mask, atLeast }) => {
    let [wanted, sure] = [bytes(value), bytes(mask)];
    if (atLeast !== undefined) wanted = wanted.subarray(0, Math.max(data.length, atLeast));
    return data.length >= wanted.length
        && wanted.every((each, place) => !((each ^ data[place]) & sure[place]));
  });
}

/** Goes on, ends the test or fails it: what an observation means. */
function take(what, expected, seen, symbol = "") {
  if (what === "ends") throw new End();
  if (what !== "passes") throw Object.assign(new Fault(`expected ${expected}, seen ${seen}`), { symbol });
}

class Player {
  constructor(vectors, device, { real, locals }) {
    Object.assign(this, { vectors, device, real, locals, config: vectors.config, configured: true });
  }

  async play(test, number) {
    const verdict = await this.judge(test);
    if (number === 1) this.configured = verdict.outcome === "passed";
    return verdict;
  }

  async judge(test) {
    const missing = (test.needs ?? []).filter((event) => !this.locals.has(event)); // 1
    if (missing.length) return { outcome: "skipped" };
    if (test.requires && !this.configured) return { outcome: "skipped" }; // 2
    let covers = [], number = 0;
    this.counter = null; // 3
    try {
      await this.device.reset();
      for (const step of test.steps) {
        number += 1;
        if (step.covers?.length) covers = step.covers;
        await this.step(step);
      }
      return { outcome: "passed" };
    } catch (error) {
      if (error instanceof End) return { outcome: "ended early" };
      if (!(error instanceof Fault)) throw error;
      const names = [...covers, ...(error.symbol?.split(" ") ?? [])];
      const cited = new Set(names.flatMap((name) => this.vectors.rules[name] ?? []));
      const clauses = cited.size ? [...cited] : test.clauses ?? [];
      const levels = clauses.map((name) => this.vectors.clauses[name]?.level).filter(Boolean);
      const lenient = !(error instanceof Death) && levels.length && !levels.includes("must");
      const reason = `step ${number} of ${test.steps.length}: ${error.message}`;
      return { outcome: lenient ? "warned" : "failed", reason, clauses };
    }
  }

  async step({ in: given, us = 0, early = false, cycle, expect = [] }) {
    if (given) await this.give(given); // 4
    if (early && this.real) { // 6
      for (let waited = 0, wait = FIRST_WAIT; waited < us && !await this.isThere(expect); wait *= 4) {
        const part = Math.min(wait, us - waited);
        await this.wait(part, cycle);
        waited += part;
      }
    } else {
      await this.wait(us, cycle); // 5
    }
    for (const expected of expect) await this[expected.kind](expected); // 7
  }

  async give({ do: kind, address, data, symbol, counter = 1, otherwise, event }) {
    if (kind === "local") {
      await this.device.local(event);
    } else if (kind === "write") {
      const seen = await this.device.write(address, bytes(data));
      if (seen !== counter) take(otherwise, `working counter ${counter} for ${symbol}`, seen, symbol);
    } else {
      const whole = Buffer.alloc(this.config.mailboxOut.length);
      bytes(data).copy(whole);
      for (let waited = 0, wait = FIRST_WAIT; !await this.device.write(address, whole); wait *= 4) {
        if (waited > this.config.requestUs) take(undefined, `the mailbox takes ${symbol}`, "working counter 0");
        await this.wait(wait);
        waited += wait;
      }
    }
  }

  async wait(us, cycle) {
    for (let left = us; left > 0;) {
      const part = cycle ? Math.min(cycle.us, left) : left;
      await this.device.advance(part);
      left -= part;
      if (cycle) await this.device.write(cycle.address, bytes(cycle.data));
    }
  }

  /** Tells whether all is there that is expected, without taking a message away. */
  async isThere(expect) {
    for (const each of expect) {
      if (each.kind === "mail") return each.none === "passes" || await this.isFull();
      if (each.kind === "full" && await this.isFull() !== each.full) return false;
      if (each.kind === "read") {
        const data = await this.device.read(each.address, each.length);
        const found = data && find(each.anyOf, data);
        if (!found || found.effect === "ends") return false;
      }
    }
    return true;
  }

  async isFull() {
    const { mailboxFull: { address, length }, mailboxFullMask: mask } = this.config;
    const data = await this.device.read(address, length);
    return data !== null && bytes(mask).some((each, place) => each & data[place]);
  }

  async read({ address, length, symbol, anyOf, refused, otherwise }) {
    const data = await this.device.read(address, length);
    if (!data) return take(refused, words(symbol, anyOf), "working counter 0", symbol);
    this.compare(anyOf, data, symbol, otherwise);
  }

  compare(anyOf, data, symbol, otherwise) {
    const found = find(anyOf, data);
    take(found ? found.effect ?? "passes" : otherwise, words(symbol, anyOf), data.toString("hex"), symbol);
  }

  async full({ full, otherwise }) {
    const seen = await this.isFull();
    if (seen !== full) take(otherwise, `a message waits: ${full}`, seen);
  }

  async mail({ anyOf, symbol = "nothing", none, otherwise, counter: rule = "any" }) {
    for (let tried = 0; tried < MOST_MAIL; tried += 1) {
      const data = await this.fetch();
      if (!data) return take(none ?? otherwise, words(symbol, anyOf), "no message");
      const before = this.counter;
      this.counter = this.counterOf(data);
      if (!find(anyOf, data) && find(this.config.passOver ?? [], data)) continue;
      this.compare(anyOf, data, symbol, otherwise);
      if (!anyOf.length) continue; // whatever was there is taken away
      const same = this.counter === before;
      const mixed = (this.counter === 0) !== (before === 0);
      const right = { any: true, new: !same || this.counter === 0, same };
      if (before !== null && (mixed || !right[rule])) take(undefined, `a ${rule} counter`, `counter ${this.counter} after ${before}`);
      return;
    }
    if (anyOf.length) throw new End(); // no end, and never what was waited for
  }

  async fetch() {
    if (!await this.isFull()) return null;
    const { mailboxIn, mailboxHead, mailboxLength: { address, length } } = this.config;
    const data = await this.device.read(mailboxIn.address, mailboxIn.length);
    return data && data.subarray(0, mailboxHead + little(data.subarray(address, address + length)));
  }

  counterOf(data) {
    const { mailboxCounter: { address, length }, mailboxCounterMask: mask } = this.config;
    return little(bytes(mask).map((each, place) => (place < length ? each & data[address + place] : 0)));
  }
}

// --- the command ----------------------------------------------------------------------------------

async function main([path, ...command]) {
  if (!command.length) throw new Wrong("usage: node replay.mjs FILE PROGRAM [ARGUMENT...]");
  const vectors = load(path), device = new Device(command);
  const counts = { passed: 0, "ended early": 0, skipped: 0, warned: 0, failed: 0 };
  try {
    const player = new Player(vectors, device, await device.describe());
    const tests = vectors.testGroups.flatMap((group) => group.tests);
    for (const [place, test] of tests.entries()) {
      const { outcome, reason, clauses } = await player.play(test, place + 1);
      counts[outcome] += 1;
      if (reason) console.log(`${outcome} ${test.id}: ${reason}; ${clauses.join(" ") || "no clause"}`);
    }
    console.log(Object.entries(counts).map(([name, number]) => `${number} ${name}`).join(", "));
    if (counts.skipped === tests.length) throw new Wrong("no test could be played");
  } finally {
    device.close();
  }
  return counts.failed ? 1 : 0;
}

process.stdout.on("error", () => process.exit(2)); // who was to read it is gone

main(process.argv.slice(2)).then((status) => { process.exitCode = status; }, (error) => {
  console.error(error instanceof Wrong ? error.message : error);
  process.exitCode = 2;
});
