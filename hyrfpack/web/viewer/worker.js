// Starts the worker of pages that open files of all formats, and scene folders.

import { decodeSplats } from "./formats/index.js";
import { SceneStream } from "./stream/scene_stream.js";
import { startWorker } from "./worker_tasks.js";

startWorker(decodeSplats, SceneStream);
