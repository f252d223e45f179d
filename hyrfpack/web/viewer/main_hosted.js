// The script of a page that plays the scenes of its server, or of others, also scene folders.

import { startPage } from "./page.js";
import { STREAMING } from "./stream/stream_loader.js";
import { watchTraining } from "./training.js";

startPage({ streaming: STREAMING, watchTraining });
