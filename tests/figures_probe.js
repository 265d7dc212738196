// Runs in a page: waits for every picture, film and inner page, and writes down what came of each.
window.addEventListener("load", async () => {
  const pause = (ms) => new Promise((done) => setTimeout(done, ms));
  const size = {
    IMG: async (x) => [x.naturalWidth, x.naturalHeight],
    VIDEO: async (x) => {
      for (let k = 0; k < 40 && x.readyState < 2; k++) await pause(100);
      return [x.videoWidth, x.videoHeight];
    },
    IFRAME: async (x) => {
      x.scrollIntoView(); // what is out of sight is not drawn
      const drawn = () => [...(x.contentDocument?.querySelectorAll("canvas") ?? [])].find((c) => c.width > 100);
      for (let k = 0; k < 80 && !drawn(); k++) await pause(100);
      return [drawn()?.width ?? 0, drawn()?.height ?? 0];
    },
  };
  const found = [];
  for (const x of document.querySelectorAll("img, video, iframe")) {
    const [width, height] = await size[x.tagName](x);
    const box = x.getBoundingClientRect();
    found.push({ kind: x.tagName, width, height, shown_px: box.width * box.height, alt: x.alt ?? "" });
  }
  const wide = [...document.querySelectorAll("table, svg, math")]
    .filter((x) => x.getBoundingClientRect().right > document.documentElement.clientWidth)
    .map((x) => `${x.tagName} ${x.textContent.trim().slice(0, 60)}`);
  const pre = document.createElement("pre");
  pre.id = "probe";
  pre.textContent = JSON.stringify({ found, wide });
  document.body.append(pre);
});
