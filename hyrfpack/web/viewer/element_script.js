// Defines <hyrf-viewer> in a classic script that pages load without a build step.

import { defineElement } from "./element.js";
import { siblingAddress } from "./script_address.js";
import { setTextSource } from "./texts.js";

setTextSource((name) => EMBEDDED_TEXTS[name]); // a constant that hyrfpack.web.player writes in front of the script
defineElement(siblingAddress("player-worker.js"));
