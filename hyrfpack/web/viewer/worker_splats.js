// Starts the worker of pages with embedded splats. They open files of all formats, but fetch nothing.

import { decodeSplats } from "./formats/index.js";
import { startWorker } from "./worker_tasks.js";

startWorker(decodeSplats);
