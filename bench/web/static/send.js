// Requests that change something: sent once. Nothing is repeated after a lost connection.

const TIME = 8000; // ms
export const COMMAND_TIME = 200000; // ms, of a command that the server runs
const UNKNOWN = {
  what: "No answer: it is unknown whether the command arrived.",
  action: "Look at the robot. No command is repeated automatically.",
};

export async function send(path, body = {}, ticket = "", time = TIME) {
  try {
    const response = await fetch(path, {
      method: "POST",
      headers: { "content-type": "application/json", ...(ticket ? { "golfbench-ticket": ticket } : {}) },
      body: JSON.stringify(body),
      cache: "no-store",
      redirect: "error",
      signal: AbortSignal.timeout(time),
    });
    const answer = await response.json().catch(() => ({ what: "The answer is not readable.", action: "Look at the robot." }));
    return { ok: response.ok, status: response.status, ...answer };
  } catch {
    return { ok: false, status: 0, ...UNKNOWN };
  }
}

export const say = (answer, done) => (answer.ok ? done : [answer.what, answer.action].filter(Boolean).join(" "));
