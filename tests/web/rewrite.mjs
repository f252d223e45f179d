// Writes edited files as the player does: `node rewrite.mjs CASES.json WRITER`. Each case has the paths `source` and `target`
// and a list of `actions`. Prints for each whether all Gaussians are kept, and the command that does the same, as JSON.

import { readFileSync, writeFileSync } from "node:fs";
import { read } from "../../hyrfpack/web/hyrf/index.js";
import { commandText, selectionsOf } from "../../hyrfpack/web/viewer/edit/actions.js";
import { keepsGaussians, rewriteFile, writeKept } from "../../hyrfpack/web/viewer/edit/rewrite.js";
import { modelScene } from "../../hyrfpack/web/viewer/scene.js";
import { measureGaussians, selectGaussians } from "../../hyrfpack/web/viewer/selection.js";

const [casesPath, writer] = process.argv.slice(2), answers = [];
for (const { source, actions, target } of JSON.parse(readFileSync(casesPath, "utf8"))) {
  const bytes = new Uint8Array(readFileSync(source)), model = await read(bytes), keeps = keepsGaussians(actions);
  const selections = selectionsOf(actions, modelScene(model, "a scene"));
  const { kept } = selectGaussians(selections, model.positions, await measureGaussians(bytes));
  const rewritten = keeps ? rewriteFile(bytes, actions, writer) : writeKept(bytes, { model, kept }, actions, writer);
  writeFileSync(target, await rewritten);
  answers.push({ keeps, command: commandText(actions, source) });
}
console.log(JSON.stringify(answers));
