"use strict";
// Photographs wait in `queue` until the server has answered for them; what a lost connection cost is sent once more,
// which is no second photograph since the server knows its bytes.
const $ = id => document.getElementById(id);
const mostBytes = Number(document.body.dataset.mostBytes);
const queue = [], taps = new Map(), points = [], loupeZoom = 4;
const shown = $("tap").querySelector("img"), handles = [...$("tap").querySelectorAll("button")];
let sending = false, into = null, known = "", tapped, answered;

function make(tag, text, kind) {
  const made = document.createElement(tag);
  if (text !== undefined) made.textContent = text;
  if (kind) made.className = kind;
  return made;
}

function enqueue(path, file, body) {
  const row = make("li", "waiting");
  $("queue").append(row);
  if (file.size > mostBytes) refuse(row, `Expected a photograph of at most ${mostBytes / 1e6} MB, got a larger file.`);
  else queue.push({path, file, body, row});
  send();
}

const enqueuePhoto = file => enqueue(`photos?into=${encodeURIComponent($("into").value)}`, file, file);

function refuse(row, sentence) {
  row.textContent = sentence;
  row.className = "broken";
}

async function send() {
  if (sending) return;
  sending = true;
  let wait = 1;
  while (queue.length) {
    const {path, file, body, row} = queue[0];
    row.textContent = "sending and measuring …";
    try {
      const answered = await fetch(path, {method: "POST", body});
      if ([408, 502, 503, 504, 507].includes(answered.status)) throw new Error((await answered.json()).refused);
      const said = await answered.json();
      queue.shift();
      if (!answered.ok) { refuse(row, said.refused); continue; }
      row.remove();
      answer(said.photo, file);
      show(said.state);
      wait = 1;
    } catch (error) {
      row.textContent = `not sent yet (${error.message || "no connection"}): trying again in ${wait} s, keep this page open`;
      await Promise.race([new Promise(done => setTimeout(done, 1000 * wait)),
        new Promise(done => addEventListener("online", done, {once: true}))]);
      wait = Math.min(30, 2 * wait);
    }
  }
  sending = false;
}

function lines(photo) {
  const box = make("div"), head = make("p");
  head.append(make("b", photo.answer, photo.answer.replace(" ", "-")), photo.label ? ` as ${photo.label}` : "");
  box.append(head);
  if (photo.advice) box.append(make("p", photo.advice, "advice"));
  box.append(make("p", `${photo.file}${photo.view ? ": " + photo.view : ""}`, "soft"));
  return box;
}

function answer(photo, file) {
  answered = photo.file;
  if (photo.tap) taps.set(photo.file, {file, preview: photo.picture});
  else taps.delete(photo.file);
  const parts = [lines(photo)];
  if (photo.picture && !photo.tap) {
    const picture = make("img");
    picture.src = photo.picture;
    picture.alt = "the photograph with what was found of the piece";
    parts.unshift(picture);
  }
  $("answer").replaceChildren(...parts);
  $("answer").hidden = false;
  nextTap();
}

// Photographs wait in `taps` for the design's corners, shares of their sides; where a browser shows no HEIC its preview is.
function nextTap() {
  const [name, {file, preview} = {}] = taps.entries().next().value || [];
  $("corners").hidden = !name;
  if (name === tapped || !(tapped = name)) return;
  shown.onerror = () => { shown.onerror = null; shown.src = preview || "data:,"; };
  shown.src = URL.createObjectURL(file);
  [[.25, .25], [.75, .25], [.75, .75], [.25, .75]].forEach((at, i) => movePoint(i, ...at));
}

function movePoint(i, ...at) {
  const [x, y] = points[i] = at.map(share => Math.min(1, Math.max(0, share))), loupe = $("loupe").style;
  Object.assign(handles[i].style, {left: `${100 * x}%`, top: `${100 * y}%`});
  $("outline").setAttribute("points", points.join(" "));
  const [width, height] = [loupeZoom * shown.width, loupeZoom * shown.height], middle = $("loupe").clientWidth / 2;
  loupe.background = `${middle - x * width}px ${middle - y * height}px / ${width}px ${height}px no-repeat url("${shown.src}") #000`;
  loupe.left = x < .5 ? "auto" : ".4rem";
}

handles.forEach((handle, i) => {
  handle.onpointerdown = ({clientX, clientY, pointerId}) => {
    const [x, y] = points[i];  // the finger keeps its distance to the point, which it would cover
    handle.setPointerCapture(pointerId);
    handle.onpointermove = to => movePoint(i, x + (to.clientX - clientX) / shown.width, y + (to.clientY - clientY) / shown.height);
    $("loupe").hidden = false;
    movePoint(i, x, y);
  };
  handle.onlostpointercapture = () => { handle.onpointermove = null; $("loupe").hidden = true; };
});

function show(state) {
  const text = JSON.stringify(state);
  if (text === known) return;
  known = text;
  const head = make("h1", `${state.headline}${state.judged ? ", so far" : ""}`, state.verdict);
  $("verdict").querySelector("h1").replaceWith(head);
  $("reason").textContent = state.reason;
  $("effect").textContent = state.photos ? state.effect : "";
  showPlaces(state);
  showMap(state.map);
  $("plan").textContent = state.plan;
  const rows = state.sessions.map(one => row("td", one.name, `${one.judged} of ${state.each}`, one.recognized));
  const controls = state.controls.map(one => row("td", `control: ${one.name}`, one.photos, one.recognized));
  $("sessions").replaceChildren(row("th", "", "counted", "recognized"), ...rows, ...controls);
  const before = state.latest.filter(photo => photo.file !== answered);  // that one is shown above
  $("latest").replaceChildren(...before.map(photo => { const item = make("li"); item.append(lines(photo)); return item; }));
}

function row(tag, ...cells) {
  const made = make("tr");
  made.append(...cells.map(cell => make(tag, cell)));
  return made;
}

function showPlaces(state) {
  const names = state.sessions.map(one => one.name), controls = state.controls_known;
  if (![...names, ...controls].includes(into)) into = names[names.length - 1];
  const shown = controls.includes(into) ? [...names, into] : names;
  $("into").replaceChildren(...shown.map(name => new Option(controls.includes(name) ? `control: ${name}` : name, name)));
  $("into").value = into;
  $("controls").replaceChildren(make("span", "A control in its place"), ...controls.map(name => {
    const chip = make("button", name);
    chip.addEventListener("click", () => { into = name; showPlaces(state); });
    return chip;
  }));
}

function showMap(map) {
  $("views").hidden = !map;
  if (!map) return;
  $("share").hidden = !map.of_picture;
  const head = row("th", "", ...map.columns);
  const rows = map.rows.map((name, i) => {
    const line = make("tr");
    line.append(make("th", name));
    map.photos[i].forEach((photos, j) => {
      const wanted = map.wanted[i][j], cell = make("td", wanted || photos ? `${photos} / ${wanted}` : "–");
      if (photos >= wanted && wanted) cell.classList.add("full");
      else if (photos) cell.classList.add("some");
      if (map.next && map.next[0] === i && map.next[1] === j) cell.classList.add("next");
      line.append(cell);
    });
    return line;
  });
  $("map").replaceChildren(head, ...rows);
  const [i, j] = map.next || [];
  const none = "Every view has the photographs that it needs.";
  const unknown = map.elsewhere ? ` Of ${map.elsewhere} more it is not known from where they are.` : "";
  const size = map.of_picture ? ", so near that the piece takes" : ", at";
  $("next").textContent = (map.next ? `Next: ${map.columns[j]}${size} ${map.rows[i]}.` : none) + unknown;
}

async function refresh() {
  try {
    const answered = await fetch("state");
    if (answered.ok) show(await answered.json());
    $("soon").textContent = answered.ok ? "" : "This address is not valid any more: open the one that the terminal shows.";
  } catch { $("soon").textContent = "No connection: photographs are kept here until it is back, at this address."; }
}

for (const id of ["camera", "choose"]) {
  $(id).addEventListener("change", event => { [...event.target.files].forEach(enqueuePhoto); event.target.value = ""; });
}
$("into").addEventListener("change", event => { into = event.target.value; });
$("session").addEventListener("click", async () => {
  try {
    const begun = await (await fetch("sessions", {method: "POST"})).json();
    into = begun.session;
    show(begun.state);
  } catch { refresh(); }
});
$("send").addEventListener("click", () => {
  const size = [shown.naturalWidth, shown.naturalHeight], pixels = points.flat().map((share, i) => (share * size[i % 2]).toFixed(2));
  enqueue(`corners?${new URLSearchParams({of: tapped, numbers: [...pixels, ...size]})}`, taps.get(tapped).file);
});
$("skip").addEventListener("click", () => { taps.delete(tapped); nextTap(); });
addEventListener("beforeunload", event => { if (queue.length) event.preventDefault(); });
addEventListener("online", refresh);
refresh();
setInterval(() => { if (document.visibilityState === "visible") refresh(); }, 4000);
