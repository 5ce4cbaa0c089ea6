// What the page of MuJoCo Studio does not do by itself: it tells of every key at once, however slow
// its pictures are, it tells how many pictures it draws, and it draws fewer pixels when asked to.
(() => {
  const LEAST_PICTURES = 4;
  const LEAST_MILLISECONDS = 3000; // of a measurement
  const RETRY_MILLISECONDS = 1000;

  let socket = null;
  let waiting = []; // what was pressed before there was a connection
  let share = 1; // of the pixels of a side that the screen has
  let pictures = 0;
  let begin = 0;

  function tell(message) {
    if (window.Module && Module.isSpectator) return;
    const text = JSON.stringify(message);
    if (socket.readyState === WebSocket.OPEN) socket.send(text);
    else waiting.push(text);
  }

  function connect() {
    socket = new WebSocket(location.origin.replace(/^http/, "ws") + "/drive");
    socket.onopen = () => {
      waiting.forEach((text) => socket.send(text));
      waiting = [];
    };
    socket.onmessage = (event) => resize(JSON.parse(event.data).share);
    socket.onclose = () => setTimeout(connect, RETRY_MILLISECONDS);
  }

  // --- keys: letters as they are on the keyboard, all others by their place ---------------------

  function nameOf(event) {
    if (/^[a-z]$/i.test(event.key)) return event.key.toUpperCase();
    return event.code.replace(/^(Arrow|Digit|Numpad)/, "");
  }

  function listen(event) {
    if (event.repeat || event.ctrlKey || event.metaKey || event.altKey) return;
    tell({ key: nameOf(event), down: event.type === "keydown", at: event.timeStamp });
  }

  window.addEventListener("keydown", listen, true);
  window.addEventListener("keyup", listen, true);
  window.addEventListener("blur", () => tell({ released: true }));

  // --- pictures ---------------------------------------------------------------------------------

  const ratio = Object.getOwnPropertyDescriptor(window, "devicePixelRatio");
  Object.defineProperty(window, "devicePixelRatio", {
    configurable: true,
    get: () => share * ratio.get.call(window),
  });

  function restart() {
    pictures = 0;
    begin = performance.now();
  }

  function resize(wanted) {
    if (wanted === share) return;
    share = wanted;
    window.dispatchEvent(new Event("resize"));
    restart();
  }

  function count() {
    requestAnimationFrame(count);
    pictures += 1;
    const taken = performance.now() - begin;
    if (pictures < LEAST_PICTURES || taken < LEAST_MILLISECONDS) return;
    tell({ pictures: (1000 * pictures) / taken });
    restart();
  }

  document.addEventListener("visibilitychange", restart); // a hidden page draws nothing
  connect();
  restart();
  requestAnimationFrame(count);
})();
