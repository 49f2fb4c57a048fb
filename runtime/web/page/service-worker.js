/**
 * Keeps the page's files for use without network, and adds the headers that give WebAssembly several threads
 * (cross-origin isolation), which static hosts do not send.
 */

// Both are filled in by `idesplat web`. FILES: what the page needs to open; the model and the engine are kept when used.
const CACHE = "idesplat-DEVELOPMENT";
const FILES = ["./"];
// The browser asks the host whether its own copy is current: one of an older version does not fit the other files.
const REVALIDATED = /** @type {const} */ ({ cache: "no-cache" });
const HEADERS = {
  "Cross-Origin-Opener-Policy": "same-origin",
  "Cross-Origin-Embedder-Policy": "require-corp",
  "Cross-Origin-Resource-Policy": "same-origin",
};

self.addEventListener("install", (event) => {
  self.skipWaiting();
  event.waitUntil(keepFiles());
});

async function keepFiles() {
  const cache = await caches.open(CACHE);
  const keep = async (name) => {
    const response = await fetch(name, REVALIDATED);
    // An error page would be kept in place of the file until the next version.
    const { ok, status } = response;
    if (!ok) throw new Error(`${name}: the server answers ${status}; copy the whole folder to the host`);
    await cache.put(name, isolated(response));
  };
  await Promise.all(FILES.map(keep));
}

self.addEventListener("activate", (event) => {
  const tidy = async () => {
    for (const name of await caches.keys()) {
      if (name.startsWith("idesplat-") && name !== CACHE) await caches.delete(name);
    }
    await self.clients.claim();
  };
  event.waitUntil(tidy());
});

self.addEventListener("fetch", (event) => {
  const { request } = event;
  const own = new URL(request.url).href.startsWith(self.registration.scope);
  if (own && request.method === "GET") event.respondWith(answer(request));
});

async function answer(request) {
  const cache = await caches.open(CACHE);
  const kept = await cache.match(request, { ignoreSearch: true });
  if (kept) return kept;
  const response = isolated(await fetch(request, REVALIDATED));
  if (response.status === 200) {
    // In the background: the page need not wait for the disk, and a full one is no error.
    cache.put(request, response.clone()).catch(() => {});
  }
  return response;
}

function isolated(response) {
  if (response.status === 0) return response;
  const headers = new Headers(response.headers);
  for (const [name, value] of Object.entries(HEADERS)) headers.set(name, value);
  const { status, statusText } = response;
  return new Response(response.body, { status, statusText, headers });
}
