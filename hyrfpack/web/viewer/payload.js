// Reads the file that is embedded in the page.

const READ_INTERVAL_MS = 20; // the wait for more of the page while it is loading

// Yields the bytes of the page's base64 blocks as the page loads. Each block is removed after it is read.
export async function* readPayload() {
  for (;;) {
    const [block, next] = document.querySelectorAll("script.payload");
    const whole = document.readyState !== "loading";
    if (block && (next || whole)) {
      yield decodeBase64(block.textContent);
      block.remove();
    } else if (whole) {
      return;
    }
    await new Promise((resolve) => setTimeout(resolve, next || whole ? 0 : READ_INTERVAL_MS));
  }
}

function decodeBase64(base64) {
  if (Uint8Array.fromBase64) return Uint8Array.fromBase64(base64);
  const text = atob(base64), bytes = new Uint8Array(text.length);
  for (let k = 0; k < text.length; k++) bytes[k] = text.charCodeAt(k);
  return bytes;
}
