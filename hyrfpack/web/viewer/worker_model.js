// Starts the worker of pages with an embedded model. It is smaller, because it reads no other format.

import { HyrfFormatError } from "../hyrf/errors.js";
import { startWorker } from "./worker_tasks.js";

startWorker(() => {
  throw new HyrfFormatError(
    "this page takes .hyrf files only; drop others on a player from 'hyrfpack export -o player/'.",
  );
});
