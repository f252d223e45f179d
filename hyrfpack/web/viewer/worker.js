// Starts the worker of pages that open files of all formats.

import { decodeSplats } from "./formats/index.js";
import { startWorker } from "./worker_tasks.js";

startWorker(decodeSplats);
