// Decodes payloads of Sparkplug B with the Tahu project's package sparkplug-payload: one in hexadecimal digits a line, JSON a line.
"use strict";
const payload = require("sparkplug-payload").get("spBv1.0");
const plain = (key, value) => (value !== null && typeof value === "object" && typeof value.low === "number"
    ? Number(value.toString()) : value);
const lines = require("readline").createInterface({ input: process.stdin });
lines.on("line", (line) => process.stdout.write(
    `${JSON.stringify(payload.decodePayload(Buffer.from(line, "hex")), plain)}\n`));
