// Prints the minor versions of files as the player states them: `node minor_versions.mjs CASES.json`. Each case has the
// `sections` of a file, with their types and codecs, and its `config`.

import { readFileSync } from "node:fs";
import { lowestMinorVersion } from "../../hyrfpack/web/viewer/edit/rewrite.js";

const cases = JSON.parse(readFileSync(process.argv[2], "utf8"));
console.log(JSON.stringify(cases.map(({ sections, config }) => lowestMinorVersion(sections, config))));
