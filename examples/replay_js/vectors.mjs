// Reads a file of test vectors: every key is known, and holds what
// docs/vectors.md says, so that nothing later has to doubt it.

import { readFileSync } from "node:fs";

/** The file or the program is no use: one line and exit status 2. */
export class Wrong extends Error {}

const wrong = (at, what) => { throw new Wrong(`${at} ${what}`); };
const need = (says, holds) => (value, at) => { if (!holds(value)) wrong(at, `is not ${says}`); };
const isObject = (value) => value !== null && typeof value === "object" && !Array.isArray(value);
const number = (least, most) => need(`a whole number from ${least} to ${most}`,
    (value) => Number.isInteger(value) && value >= least && value <= most);
const oneOf = (...words) => need(`one of ${words.join(", ")}`, (value) => words.includes(value));
const text = need("a text", (value) => typeof value === "string");
const truth = need("true or false", (value) => typeof value === "boolean");
const hex = need("bytes in hexadecimal",
    (value) => typeof value === "string" && /^([0-9a-f]{2})*$/.test(value));
const list = (check) => (value, at) => {
  if (!Array.isArray(value)) wrong(at, "is not a list");
  value.forEach((each, place) => check(each, `${at}[${place}]`));
};
const map = (check) => (value, at) => {
  if (!isObject(value)) wrong(at, "is not an object");
  for (const [name, each] of Object.entries(value)) check(each, `${at}.${name}`);
};
const part = (needed, optional = {}) => (value, at) => {
  if (!isObject(value)) wrong(at, "is not an object");
  const known = { ...optional, ...needed };
  for (const [name, each] of Object.entries(value)) {
    if (!Object.hasOwn(known, name)) wrong(`${at}.${name}`, "is not known");
    known[name](each, `${at}.${name}`);
  }
  for (const name of Object.keys(needed)) if (!Object.hasOwn(value, name)) wrong(at, `lacks ${name}`);
};
const tagged = (tag, parts) => (value, at) => {
  const name = isObject(value) ? value[tag] : undefined;
  if (typeof name !== "string" || !Object.hasOwn(parts, name)) wrong(at, `has no known "${tag}"`);
  parts[name](value, at);
};
const address = number(0, 0xffff), length = number(1, 0x10000), time = number(0, 3_600_000_000);
const count = number(0, Number.MAX_SAFE_INTEGER), effect = oneOf("passes", "ends");
const area = part({ address, length });
const allowed = part({ value: hex, mask: hex }, { effect, atLeast: length });
const input = tagged("do", {
  write: part({ do: text, address, data: hex, symbol: text }, { counter: oneOf(0, 1), otherwise: effect }),
  send: part({ do: text, address, data: hex, symbol: text }),
  local: part({ do: text, event: text }),
});
const expectation = tagged("kind", {
  read: part({ kind: text, address, length, symbol: text, anyOf: list(allowed) },
      { refused: effect, otherwise: effect }),
  mail: part({ kind: text, anyOf: list(allowed) },
      { symbol: text, none: effect, otherwise: effect, counter: oneOf("new", "same", "any") }),
  full: part({ kind: text, full: truth }, { otherwise: effect }),
});
const cycle = part({ address, data: hex, us: number(1, 3_600_000_000) });
const step = part({}, { in: input, us: time, early: truth, cycle, expect: list(expectation),
  state: map(text), covers: list(text) });
const test = part({ tcId: count, id: text, comment: text, steps: list(step) },
    { result: oneOf("valid", "acceptable"), flags: list(text), needs: list(text), requires: truth,
      clauses: list(text) });
const file = part({
  schema: oneOf("ecatspec.vectors"), schema_version: oneOf(1),
  generator: part({ name: text, version: text, depth: text },
      { mailbox: text, seed: need("a whole number", Number.isInteger), only: list(text) }),
  spec: part({ name: text, title: text, sha256: text }),
  numberOfTests: count, header: list(text),
  notes: map(part({ bugType: text, description: text })),
  guarantee: list(part({ tests: text, method: text, m: count, k: count, checked: text })),
  choices: map(text), open: map(text),
  config: part({ mailboxOut: area, mailboxIn: area, mailboxFull: area, mailboxFullMask: hex,
    mailboxHead: length, mailboxLength: area, mailboxCounter: area, mailboxCounterMask: hex,
    requestUs: time }, { passOver: list(allowed) }),
  rules: map(list(text)),
  clauses: map(part({ level: oneOf("must", "should", "may"), says: text, source: text })),
  testGroups: list(part({ type: text, tests: list(test) })),
});

/** Gives what the file holds. */
export function load(path) {
  let vectors;
  try {
    vectors = JSON.parse(readFileSync(path, "utf8"));
  } catch (error) {
    throw new Wrong(`cannot read ${path}: ${error.message.split("\n")[0]}`);
  }
  try {
    file(vectors, "the file");
    const found = vectors.testGroups.reduce((sum, group) => sum + group.tests.length, 0);
    if (found !== vectors.numberOfTests) wrong("numberOfTests", `does not match: there are ${found}`);
  } catch (error) {
    throw new Wrong(`${path} holds no test vectors of version 1: ${error.message}`);
  }
  return vectors;
}
