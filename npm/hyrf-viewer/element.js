// Defines <hyrf-viewer> when it is imported.

import "./index.js";
import { defineElement } from "../../hyrfpack/web/viewer/element.js";

defineElement();
