// Rewrites a file as the player does: `node rewrite.mjs MODEL.hyrf ACTIONS.json WRITER TARGET.hyrf`. Prints whether the
// player offers it, and the command that does the same, as JSON.

import { readFileSync, writeFileSync } from "node:fs";
import { commandText } from "../../hyrfpack/web/viewer/edit/actions.js";
import { canRewrite, rewriteFile } from "../../hyrfpack/web/viewer/edit/rewrite.js";

const [path, actionsPath, writer, target] = process.argv.slice(2), bytes = new Uint8Array(readFileSync(path));
const actions = JSON.parse(readFileSync(actionsPath, "utf8")), isOffered = canRewrite(actions);
if (isOffered) writeFileSync(target, await rewriteFile(bytes, actions, writer));
console.log(JSON.stringify({ isOffered, command: commandText(actions, path) }));
