// Requests to samsodd. What changes something carries the operator's token, which is asked for once and kept by this tab.

import { byId, say, toast } from "./dom.js";

const KEY = "samsod-token";
const BASE = "/api/v1";

/** An answer that is none: its text, and the code of HTTP. */
export class Refused extends Error {
  constructor(code, text) {
    super(text);
    this.code = code;
  }
}

export const hasToken = () => sessionStorage.getItem(KEY) !== null;

async function send(method, path, content, token) {
  const headers = {};
  if (token) headers.Authorization = `Bearer ${token}`;
  if (content !== undefined) headers["Content-Type"] = "application/json";
  let answer;
  try {
    answer = await fetch(BASE + path, { method, headers, body: content === undefined ? undefined : JSON.stringify(content) });
  } catch {
    throw new Refused(0, "samsodd does not answer");
  }
  if (!answer.ok) {
    const told = await answer.json().catch(() => ({}));
    throw new Refused(answer.status, told.error ?? `samsodd answered ${answer.status}`);
  }
  return answer.status === 204 ? null : answer.json();
}

/** Asks for something that changes nothing. */
export const ask = (path) => send("GET", path);

/** Asks for something that changes something. Rejects with `null` when no token was given. */
export async function change(method, path, content) {
  for (;;) {
    if (!hasToken() && !(await unlock())) throw null;
    try {
      return await send(method, path, content, sessionStorage.getItem(KEY));
    } catch (error) {
      if (error.code !== 401) throw error;
      // samsodd has been started anew, and has made another.
      lock();
    }
  }
}

/** Runs a change and tells what went wrong. Returns undefined then. */
export async function attempt(method, path, content) {
  try {
    return await change(method, path, content);
  } catch (error) {
    if (error) toast(error.message, true);
    return undefined;
  }
}

/** Forgets the token. */
export function lock() {
  sessionStorage.removeItem(KEY);
  showLock();
}

export function showLock() {
  say(byId("unlock"), hasToken() ? "Lock" : "Unlock");
}

let asking = null;
/** Asks the operator for the token, until it is right or they give up. */
export function unlock() {
  asking ??= new Promise((resolve) => {
    const [dialog, form, error] = [byId("token-dialog"), byId("token-form"), byId("token-error")];
    form.reset();
    say(error, "");
    const submit = async (event) => {
      event.preventDefault();
      const token = form.elements.token.value.trim();
      try {
        await send("POST", "/token", undefined, token);
        sessionStorage.setItem(KEY, token);
        dialog.close();
      } catch (refused) {
        say(error, refused.code === 401 ? "This is not the token." : refused.message);
        form.elements.token.select();
      }
    };
    const closed = () => {
      form.removeEventListener("submit", submit);
      asking = null;
      showLock();
      resolve(hasToken());
    };
    form.addEventListener("submit", submit);
    dialog.addEventListener("close", closed, { once: true });
    dialog.showModal();
  });
  return asking;
}
