// A React component that shows a scene.

import { createViewer } from "hyrf-viewer";
import { useEffect, useRef } from "react";

// `src`, `exposure` and `autorotate` are followed, `autorotate` unless the user prefers reduced motion. `onReady` and
// `onError` are called with the viewer's events.
export function HyrfScene({ src, exposure = "as-photographed", autorotate = false, onReady, onError, className }) {
  const container = useRef(null), viewer = useRef(null), callbacks = useRef({});
  callbacks.current = { onReady, onError };

  useEffect(() => {
    let created;
    try {
      created = createViewer({ container: container.current });
    } catch (error) { // the browser has no WebGL 2
      callbacks.current.onError?.({ error });
      return;
    }
    created.on("ready", (event) => callbacks.current.onReady?.(event));
    created.on("error", (event) => callbacks.current.onError?.(event));
    viewer.current = created;
    return () => {
      viewer.current = null;
      created.destroy();
    };
  }, []);

  useEffect(() => {
    viewer.current?.load(src).catch(() => {}); // the events report errors
  }, [src]);

  useEffect(() => {
    if (!viewer.current) return;
    viewer.current.exposure = exposure;
    viewer.current.autorotate = autorotate && !matchMedia("(prefers-reduced-motion: reduce)").matches;
  }, [exposure, autorotate]);

  return <div ref={container} className={className} />;
}
