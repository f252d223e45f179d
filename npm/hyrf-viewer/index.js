// The package's main module.

import { setTextSource } from "../../hyrfpack/web/viewer/texts.js";

setTextSource((name) => EMBEDDED_TEXTS[name]); // a constant that tools/browser/build_package.py provides

export { createViewer } from "../../hyrfpack/web/viewer/viewer.js";
