// The script of a page that plays scenes.

import { startPage } from "./page.js";

startPage();
