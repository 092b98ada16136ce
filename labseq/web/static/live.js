// The state of a run as server-sent events. A page in the background closes its connection.

export function follow(query, onState, onLink) {
  let source = null, timer = null, closed = false, wait = 500, shot = null;

  function open() {
    if (closed || source || document.hidden) return;
    source = new EventSource(`/api/v1/events${query}`);
    source.addEventListener("shot", (event) => { shot = JSON.parse(event.data); });
    source.addEventListener("state", (event) => {
      wait = 500;
      onLink(true);
      onState({ shot, ...JSON.parse(event.data) });
    });
    source.addEventListener("open", () => onLink(true));
    source.addEventListener("error", () => {
      onLink(false);
      if (source && source.readyState === EventSource.CLOSED) {  // refused: the browser gives up, we do not
        shut();
        timer = setTimeout(open, wait);
        wait = Math.min(2 * wait, 10_000);
      }
    });
  }
  function shut() {
    clearTimeout(timer);
    if (source) source.close();
    source = null;
  }
  const onVisible = () => (document.hidden ? shut() : open());
  document.addEventListener("visibilitychange", onVisible);
  open();
  return () => {
    closed = true;
    document.removeEventListener("visibilitychange", onVisible);
    shut();
  };
}

// Loads one picture at a time; of those asked for meanwhile only the newest is loaded next.
export function oneSlot(show) {
  let isLoading = false, next = null, shown = "";
  async function run(address) {
    isLoading = true;
    try {
      const answer = await fetch(address);
      if (answer.ok) show(await createImageBitmap(await answer.blob()), Number(answer.headers.get("x-reduced") ?? 1));
      else show(null, 1);
    } catch { /* the server is away; the next state asks again */ shown = ""; }
    await new Promise((done) => setTimeout(done, 500));
    isLoading = false;
    if (next) { const later = next; next = null; run(later); }
  }
  return (address) => {
    if (address === shown) return;
    shown = address;
    if (isLoading) next = address;
    else run(address);
  };
}
