// What is in the page itself.

const READ_EVERY = 20; // ms, while the page is still coming in

// The bytes in the page's blocks of base64, as they come in. Each block is dropped once it is read.
export async function* payload() {
  for (;;) {
    const [block, next] = document.querySelectorAll("script.payload");
    const whole = document.readyState !== "loading";
    if (block && (next || whole)) {
      yield bytesOf(block.textContent);
      block.remove();
    } else if (whole) {
      return;
    }
    await new Promise((resolve) => setTimeout(resolve, next || whole ? 0 : READ_EVERY));
  }
}

function bytesOf(base64) {
  if (Uint8Array.fromBase64) return Uint8Array.fromBase64(base64);
  const text = atob(base64), bytes = new Uint8Array(text.length);
  for (let k = 0; k < text.length; k++) bytes[k] = text.charCodeAt(k);
  return bytes;
}
