// Values that the browser stores: units, theme, the operator's name.

export const keep = {
  get(name, otherwise) {
    try { return localStorage.getItem(`golfbench-${name}`) ?? otherwise; } catch { return otherwise; }
  },
  put(name, value) {
    try { localStorage.setItem(`golfbench-${name}`, value); } catch { /* private mode: not kept */ }
  },
};

export function startTheme(select) {
  const apply = () => {
    if (select.value === "auto") delete document.documentElement.dataset.theme;
    else document.documentElement.dataset.theme = select.value;
  };
  select.value = keep.get("theme", "auto");
  if (!select.value) select.value = "auto";
  apply();
  select.addEventListener("change", () => { keep.put("theme", select.value); apply(); });
}
