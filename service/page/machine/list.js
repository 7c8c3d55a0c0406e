/** All mills that this server knows, each with what it does now. */

import { api } from "../lib/api.js";
import { h, replace, sheet } from "../lib/dom.js";
import { mark, shape } from "../lib/state.js";
import { percent } from "../lib/words.js";
import { runStanding, standing } from "./words.js";

const EVERY_MS = 3000;

export default async function view(root, _params, app) {
  await sheet("/page/machine/machine.css");
  app.title("Machines");
  const place = h("div", { class: "stack" });
  replace(root, h("h1", {}, "Machines"), place);
  let shown = "";
  let timer = 0;
  let left = false;

  const look = async () => {
    const found = await api.get("/v1/machines");
    const now = JSON.stringify(found.machines.map((one) => [one.name, standing(one), one.run, one.control, one.problem]));
    if (now !== shown) replace(place, content(found));
    shown = now;
  };
  const again = () => {
    timer = setTimeout(async () => {
      if (!document.hidden && !api.away) await look().catch(() => {});
      if (!left) again();
    }, EVERY_MS);
  };
  await look();
  again();
  return {
    leave() {
      left = true;
      clearTimeout(timer);
    },
  };
}

function content({ machines, problems }) {
  const faults = problems.map((words) => h("p", { class: "notice bad" }, shape("bad"), h("span", {}, words)));
  return machines.length ? [faults, h("ul", { class: "machine-list" }, machines.map(card))] : [faults, empty()];
}

function card(machine) {
  const { kind, word, words } = standing(machine);
  const run = machine.run;
  return h(
    "li",
    { class: "card" },
    h("div", { class: "row spread" }, h("h2", {}, h("a", { href: `#/machines/${encodeURIComponent(machine.name)}` }, machine.name)), mark(kind, word)),
    machine.simulated && h("p", {}, mark("warn", "Simulated: no real mill moves")),
    h("p", { class: "dim" }, machine.profile?.description ?? ""),
    words && h("p", {}, words),
    run && h("p", {}, runWords(run, machine)),
    machine.control && h("p", {}, `${machine.control.operator} has control.`),
  );
}

function runWords(run, machine) {
  const { program, share } = run;
  const [, words] = runStanding(run, machine);
  return share > 0 && share < 1 ? `${program}: ${words}, ${percent(share)} cut` : `${program}: ${words}`;
}

function empty() {
  return h(
    "div",
    { class: "card stack" },
    h("p", {}, "No mill is set up on this computer."),
    h("p", {}, "Write a file ", h("code", {}, "~/.config/causticmill/machines/my-mill.toml"), " with what yours is and where its cable ends:"),
    h("pre", { tabIndex: 0 }, 'extends = "grbl"\ndescription = "the mill by the window"\n[link]\nport = "/dev/serial/by-id/..."'),
    h("p", {}, "Then start the server again. To try everything without a mill: ", h("code", {}, "causticmill serve --with-simulated-mill"), "."),
  );
}
