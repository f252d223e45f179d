// Minifies scripts with terser: reads a JSON object of scripts by name from stdin, writes the same with minified scripts.

import { text } from "node:stream/consumers";

import { minify } from "../../tests/node/node_modules/terser/main.js";

const options = { ecma: 2020, toplevel: true, compress: { passes: 3, unsafe_arrows: true }, format: { ascii_only: false } };
const scripts = JSON.parse(await text(process.stdin));
for (const [name, script] of Object.entries(scripts)) scripts[name] = (await minify(script, options)).code;
process.stdout.write(JSON.stringify(scripts));
