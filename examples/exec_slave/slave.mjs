// A SubDevice that is a program: the line protocol of docs/adapters.md over stdin and stdout, in JavaScript.
//
//     ecatspec run standard --depth quick --dut 'exec:node examples/exec_slave/slave.mjs'
//
// It has registers and an AL state machine that knows INIT only: put your own device in its place.
import { createInterface } from "node:readline";

const AL_CONTROL = 0x0120, AL_STATUS = 0x0130, AL_STATUS_CODE = 0x0134, REGISTERS_END = 0x1000;
const INIT = 1, STATES = [1, 2, 3, 4, 8], ERROR = 0x10, ACKNOWLEDGE = 0x10;
const INVALID_STATE_CHANGE = 0x11, UNKNOWN_STATE = 0x12, NO_BOOTSTRAP = 0x13, INVALID_MAILBOX = 0x16;

let memory = Buffer.alloc(0x10000);

function showState(error, code) {
  memory.writeUInt16LE(code, AL_STATUS_CODE);
  memory.writeUInt16LE(INIT | (error ? ERROR : 0), AL_STATUS);
}

function request(control) {
  const state = control & 0x0f;
  const failed = memory.readUInt16LE(AL_STATUS) & ERROR;
  if (failed && !(control & ACKNOWLEDGE) && state !== INIT) return; // only INIT ends an error unasked
  if (state === INIT) showState(false, 0);
  else if (!STATES.includes(state)) showState(true, UNKNOWN_STATE);
  else if (state === 2) showState(true, INVALID_MAILBOX); // there is no mailbox in this device
  else showState(true, state === 3 ? NO_BOOTSTRAP : INVALID_STATE_CHANGE);
}

const writable = (at) => at >= REGISTERS_END || (at >= AL_CONTROL && at < AL_CONTROL + 2);

const operations = {
  describe: () => ({ description: {
    name: "slave.mjs", protocols: ["al"], virtual_time: true, closed_dictionary: false, batch: true,
    advance_until: true,
  } }),
  reset: () => {
    memory = Buffer.alloc(0x10000);
    memory.writeUInt16LE(INIT, AL_CONTROL);
    showState(false, 0);
    return {};
  },
  read: ({ address, length }) => ({ wkc: 1, data: memory.toString("hex", address, address + length) }),
  write: ({ address, data }) => {
    const bytes = Buffer.from(data, "hex");
    let wkc = 0;
    bytes.forEach((byte, n) => { if (writable(address + n)) { memory[address + n] = byte; wkc = 1; } });
    if (address <= AL_CONTROL && address + bytes.length > AL_CONTROL) request(memory.readUInt16LE(AL_CONTROL));
    return { wkc };
  },
  advance: () => ({}),
  close: () => ({}),
  batch: ({ calls }) => ({ results: calls.map(perform) }),
  advance_until: ({ steps, seen }) => {
    let passed = 0, results, same;
    do {
      operations.advance({ seconds: steps[passed++] });
      process.stdout.write(" "); // this step has passed
      results = seen.map((span) => perform({ op: "read", ...span }));
      same = results.every(({ wkc, data }, n) => wkc === seen[n].wkc && data === seen[n].data);
      if (same) process.stdout.write(" "); // and it showed nothing new
    } while (same && passed < steps.length);
    return { passed, results };
  },
};

function perform(call) {
  const operation = operations[call.op];
  return operation ? { ok: true, ...operation(call) } : { ok: false, error: `unknown op ${call.op}` };
}

operations.reset();
const lines = createInterface({ input: process.stdin });
lines.on("line", (line) => {
  const call = JSON.parse(line);
  process.stdout.write(`${JSON.stringify(perform(call))}\n`);
  if (call.op === "close") lines.close();
});
