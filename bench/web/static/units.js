// Units by the reader's choice; everything arrives in SI.

const SYSTEMS = {
  si: { speed: [1, "m/s", 2], distance: [1, "m", 1], pressure: [1e-5, "bar", 2] },
  us: { speed: [1 / 0.44704, "mph", 1], distance: [1 / 0.9144, "yd", 1], pressure: [1 / 6894.757293, "psi", 1] },
};
const changed = [];
let system = "si";

export function number(value, digits) {
  if (typeof value !== "number" || !Number.isFinite(value)) return "–";
  const text = value.toFixed(digits);
  return Number(text) === 0 ? text.replace("-", "") : text.replace("-", "−");
}

export function quantity(kind, value, more = 0) {
  const [factor, unit, digits] = SYSTEMS[system][kind];
  return typeof value === "number" ? `${number(value * factor, digits + more)} ${unit}` : "–";
}

export const unitSystem = () => system;
export const scale = (kind) => SYSTEMS[system][kind];
export const degrees = (value, digits = 1) => (typeof value === "number" ? `${number(value, digits)}°` : "–");
export const micro = (seconds) => (typeof seconds === "number" ? `${number(1e6 * seconds, 0)} µs` : "–");
export const onUnits = (action) => changed.push(action);

export function startUnits(select, keep) {
  select.value = keep.get("units", "si");
  system = select.value in SYSTEMS ? select.value : "si";
  select.addEventListener("change", () => {
    system = select.value;
    keep.put("units", system);
    for (const action of changed) action();
  });
}
