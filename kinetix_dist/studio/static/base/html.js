// The view library: Preact with tagged templates, no build step.
export { html, render, useEffect, useMemo, useRef, useState } from "../vendor/htm_preact.js";
