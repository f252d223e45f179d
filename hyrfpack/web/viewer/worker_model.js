// The worker of pages with a model inside: smaller, for it reads no other kind of file.

import { HyrfFormatError } from "../hyrf/errors.js";
import { startWorker } from "./reading.js";

startWorker(() => {
  throw new HyrfFormatError("this page takes .hyrf files only; drop others on a player from 'hyrfpack export -o player/'.");
});
