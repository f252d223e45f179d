// Unpacks the player: its texts go to where scripts find them by name, its script runs. The page's policy names both
// scripts. Until it runs, `hyrfpack.ready` is the promise of its own.

{
  const unpacked = async (text) => {
    if (!window.DecompressionStream) throw new Error("This browser is too old for this page; take a newer one.");
    const bytes = Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
    const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"));
    return JSON.parse(await new Response(stream).text());
  };

  const put = (type, id, text) => {
    const script = Object.assign(document.createElement("script"), { type, id });
    script.append(text);
    document.body.append(script);
  };

  const boot = async () => {
    const { "main.js": main, ...texts } = await unpacked(document.getElementById("player").textContent);
    for (const [name, text] of Object.entries(texts)) put("text/plain", name, text);
    put("text/javascript", "main.js", main);
  };

  const booted = boot(), before = { ready: booted.then(() => window.hyrfpack !== before && window.hyrfpack.ready) };
  window.hyrfpack = before;
  before.ready.catch(() => {}); // the page says it
  booted.catch(({ message }) => {
    document.getElementById("sentence").textContent = message;
    document.getElementById("message").hidden = false;
  });
}
