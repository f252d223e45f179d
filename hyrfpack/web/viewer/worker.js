// The worker of pages that take files of every kind.

import { decodeSplats } from "./formats/index.js";
import { startWorker } from "./reading.js";

startWorker(decodeSplats);
