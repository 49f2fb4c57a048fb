/**
 * Keeps the page's files for use without network, and adds the headers that give WebAssembly several threads
 * (cross-origin isolation), which static hosts do not send.
 */

// Both are filled in by `idesplat web`. FILES: what the page needs to open; the model and the engine are kept when used.
const CACHE = "idesplat-DEVELOPMENT";
const FILES = ["./"];
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
  const keep = async (name) => cache.put(name, isolated(await fetch(name, { cache: "no-cache" })));
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
  const response = isolated(await fetch(request));
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
