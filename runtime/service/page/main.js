/** The page of the service: sends images, follows the job, shows and downloads what it has made. */

const FORMATS = [".ply", ".spz", ".sog", ".splat", ".compressed.ply", ".glb", ".points.ply", ".xyz"];
const CAMERAS = /\.(json|txt|bin|npy|ya?ml|xml)$/i;
const TOKEN = "idesplat-token";
const UNAUTHORIZED = 401;

const element = (id) => document.getElementById(id);
const cached = new Map(); // blob URLs of the result, by name
let files = [];
let scene = null; // the job's state
let generation = 0; // of the job; what comes for an earlier one is left out

element("token").value = sessionStorage.getItem(TOKEN) ?? "";
for (const format of FORMATS) element("format").add(new Option(format));

element("files").addEventListener("change", (event) => choose([...event.target.files]));
for (const kind of ["dragover", "dragleave", "drop"]) {
  addEventListener(kind, (event) => {
    event.preventDefault();
    element("drop").classList.toggle("over", kind === "dragover");
    if (kind === "drop") choose([...event.dataTransfer.files]);
  });
}
element("form").addEventListener("submit", (event) => {
  event.preventDefault();
  start().catch(fail);
});
element("cancel").addEventListener("click", () => cancel().catch(fail));
element("position").addEventListener("input", () => show().catch(fail));
element("download").addEventListener("click", () => download(`scene${element("format").value}`).catch(fail));
element("summary").addEventListener("click", () => download("summary.json").catch(fail));

function choose(given) {
  files = given;
  const cameras = files.filter((file) => CAMERAS.test(file.name)).length;
  const images = files.length - cameras;
  const found = [`${images} image${images === 1 ? "" : "s"}`];
  if (cameras) found.push(`${cameras} file${cameras === 1 ? "" : "s"} of cameras`);
  element("chosen").textContent = files.length ? found.join(", ") : "";
  element("focal-label").hidden = cameras > 0;
  element("start").disabled = images === 0;
}

async function start() {
  const form = new FormData();
  for (const file of files) form.append(CAMERAS.test(file.name) ? "cameras" : "images", file);
  form.append("quality", element("quality").value);
  form.append("render", "true");
  if (!element("focal-label").hidden) form.append("focal", element("focal").value.trim());
  sessionStorage.setItem(TOKEN, element("token").value);
  const own = ++generation;
  forget();
  element("error").hidden = true;
  element("result").hidden = true;
  working(true);
  scene = await send(form);
  element("cancel").hidden = false;
  await follow(own);
}

/** Send the form; unlike `fetch`, this request tells how much of it has been sent. */
function send(form) {
  return new Promise((resolve, reject) => {
    const request = new XMLHttpRequest();
    request.open("POST", "v1/scenes");
    for (const [name, value] of Object.entries(headers())) request.setRequestHeader(name, value);
    request.upload.addEventListener("progress", (event) => tell("sending", event.loaded, event.total));
    request.upload.addEventListener("load", () => tell("checking the files"));
    request.addEventListener("error", () => reject(new Error("the service cannot be reached")));
    request.addEventListener("load", () => {
      if (request.status === 202) resolve(JSON.parse(request.responseText));
      else reject(problem(request.status, request.responseText));
    });
    request.send(form);
  });
}

/** Read the job's events until it has ended. An `EventSource` could not send the token. */
async function follow(own) {
  const answer = await get("events");
  const reader = answer.body.pipeThrough(new TextDecoderStream()).getReader();
  let text = "";
  for (;;) {
    const { value, done } = await reader.read();
    if (own !== generation) return reader.cancel();
    if (done) break;
    text += value;
    const events = text.split("\n\n");
    text = events.pop();
    for (const event of events) {
      scene = JSON.parse(event.slice(event.indexOf("data: ") + "data: ".length));
      update();
    }
  }
  working(false);
  if (scene.state === "done") await showResult();
  else if (scene.state === "failed") throw new Error(scene.error);
  else if (scene.state !== "cancelled") throw new Error("the connection to the service was lost");
}

function update() {
  if (scene.state === "queued") tell(scene.position ? `waiting for ${scene.position} other scenes` : "waiting");
  else if (scene.progress) tell(scene.progress.description, scene.progress.done, scene.progress.total);
}

async function cancel() {
  await request(scene.url.slice(1), { method: "DELETE" });
}

async function showResult() {
  const frames = names("renders/path-");
  element("rendered").hidden = frames.length === 0;
  element("position").max = frames.length - 1;
  element("position").value = 0;
  element("facts").textContent = `${scene.gaussians.toLocaleString()} Gaussians from ${scene.views.join(", ")}, in ` +
    `${(scene.finished - scene.started).toFixed(1)} s`;
  element("notes").replaceChildren(...scene.notes.map((note) => {
    const line = document.createElement("li");
    line.textContent = note;
    return line;
  }));
  element("depth").replaceChildren();
  element("result").hidden = false;
  element("result-title").focus();
  await show();
  for (const name of scene.files.filter((file) => file.startsWith("depth/") && file.endsWith(".png"))) {
    const image = document.createElement("img");
    image.alt = `Depth of ${name.slice("depth/".length, -".png".length)}`;
    image.src = await blobUrl(name);
    element("depth").append(image);
  }
  for (const name of frames) await blobUrl(name);
}

async function show() {
  const name = names("renders/path-")[element("position").valueAsNumber];
  if (name) element("frame").src = await blobUrl(name);
}

async function download(name) {
  const button = element("download");
  button.disabled = true;
  try {
    const link = document.createElement("a");
    link.href = await blobUrl(name);
    link.download = name;
    link.click();
  } finally {
    button.disabled = false;
  }
}

const names = (start) => (scene?.files ?? []).filter((file) => file.startsWith(start)).sort();

async function blobUrl(name) {
  if (!cached.has(name)) cached.set(name, URL.createObjectURL(await (await get(name)).blob()));
  return cached.get(name);
}

function forget() {
  for (const url of cached.values()) URL.revokeObjectURL(url);
  cached.clear();
}

const get = (name) => request(`${scene.url.slice(1)}/${name.split("/").map(encodeURIComponent).join("/")}`);

async function request(path, options = {}) {
  const answer = await fetch(path, { ...options, headers: headers() });
  if (!answer.ok) throw problem(answer.status, await answer.text());
  return answer;
}

function headers() {
  const token = element("token").value;
  return token ? { Authorization: `Bearer ${token}` } : {};
}

/** An answer's problem as an error; where a token is missing, its field is shown. */
function problem(status, text) {
  if (status === UNAUTHORIZED) {
    element("token-row").hidden = false;
    element("token").focus();
    return new Error("this service needs a token");
  }
  try {
    return new Error(JSON.parse(text).detail);
  } catch {
    return new Error(`the service answered ${status}`);
  }
}

function tell(stage, done = 0, total = null) {
  const bar = element("progress");
  if (total) [bar.max, bar.value] = [total, done];
  else bar.removeAttribute("value");
  element("stage").textContent = stage;
}

function working(on) {
  element("working").hidden = !on;
  element("start").disabled = on;
  if (!on) element("cancel").hidden = true;
}

function fail(error) {
  working(false);
  element("error").textContent = error.message;
  element("error").hidden = false;
}
