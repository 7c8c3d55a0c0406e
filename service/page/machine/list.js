/** All mills of the shop on one screen: the state and progress of each, and HOLD, which keeps its place. If there is only one mill, its own screen opens at once. */

import { api } from "../lib/api.js";
import { h, replace, sheet, write } from "../lib/dom.js";
import { t } from "../lib/language.js";
import { isDry, mark, shape } from "../lib/state.js";
import { percentUnderWay, sentence } from "../lib/words.js";
import { thumbnail } from "../jobs/card.js";
import { isHeld, isLive, mills } from "./mills.js";
import { notifySwitch } from "./notify.js";
import { addressOf, leftWords, millWords, outOfReach, programWords, standingInShop } from "./words.js";

export default async function view(root, _params, app) {
  await sheet("/page/machine/machine.css");
  app.title(t("Machines"));
  const faults = h("div", { class: "stack" });
  const list = h("ul", { class: "machine-list" });
  const none = empty();
  const cards = new Map(); // name -> {node, update(machine)}

  function show() {
    const { machines, problems } = mills.seen;
    const words = problems.join("\n");
    if (faults.dataset.words !== words) replace(faults, problems.map((one) => h("p", { class: "notice bad" }, shape("bad"), h("span", {}, one))));
    faults.dataset.words = words;
    faults.hidden = !words;
    none.hidden = machines.length > 0;
    list.hidden = machines.length === 0;
    const gone = new Set(cards.keys());
    for (const machine of machines) {
      gone.delete(machine.name);
      if (!cards.has(machine.name)) cards.set(machine.name, card(machine.name));
      cards.get(machine.name).update(machine);
    }
    for (const name of gone) cards.delete(name);
    const order = machines.map(({ name }) => cards.get(name).node);
    if (order.some((node, k) => list.children[k] !== node) || list.children.length !== order.length) list.replaceChildren(...order);
  }

  await mills.look();
  const { machines, problems } = mills.seen;
  if (machines.length === 1 && !problems.length) return app.go(addressOf(machines[0].name), { instead: true }); // there is nothing to choose
  show();
  replace(root, h("div", { class: "list-head" }, h("h1", {}, t("Machines")), notifySwitch()), h("div", { class: "stack" }, faults, list, none));
  return { leave: mills.watch(show) };
}

/** Targets of a press stay in place: the parts of a card are made once, with a height independent of their text. */
function card(name) {
  const state = h("p", { class: "state" });
  const hold = h("button", { type: "button", class: "big hold", "aria-label": t`HOLD ${name}`, onclick: () => mills.hold(name) }, t("HOLD"));
  const alarm = h("p", { class: "arrived", role: "alert" });
  const share = h("strong", {});
  const bar = h("progress", { max: 1, "aria-label": t("Cut so far") });
  const picture = h("img", { class: "wall-seen", width: 72, height: 72, alt: "", hidden: true }), wall = thumbnail(picture);
  const meter = h("div", { class: "cut" }, bar, share);
  const words = h("p", { class: "words" });
  const about = h("p", { class: "dim" });
  const link = h("a", { href: addressOf(name) }, name);
  const node = h(
    "li",
    { class: "card" },
    h("div", { class: "row spread" }, h("div", {}, h("h2", {}, link), state), picture, hold),
    about,
    alarm,
    words,
    meter,
  );
  let drawn = "", lens = { id: "", name: "" };

  /** What is being cut: the wall of its job, and its name. */
  async function showJob(id) {
    lens = { id, name: "" };
    const job = id && (await api.get(`/v1/jobs/${id}`, { quiet: true }).catch(() => null));
    if (lens.id !== id) return;
    lens.name = job?.name ?? "";
    picture.hidden = !job;
    wall.show(job ? job.links.picture : null);
  }

  function update(machine) {
    const { kind, word } = standingInShop(machine);
    if (`${kind} ${word}` !== drawn) replace(state, mark(kind, word));
    drawn = `${kind} ${word}`;
    const { simulated, control, profile, run } = machine;
    const cut = run?.share > 0, job = run?.job ?? "";
    if (job !== lens.id) showJob(job);
    hold.style.visibility = isLive(machine) ? "visible" : "hidden";
    hold.classList.toggle("taken", isHeld(machine));
    write(alarm, mills.stopper(name).words);
    write(share, cut ? percentUnderWay(run.share) : "");
    meter.style.visibility = cut ? "visible" : "hidden";
    bar.value = run?.share ?? 0;
    write(words, [run && programWords(isDry(run) ? t`Dry pass of ${run.program}` : run.program, lens.name), whyWords(machine) || (cut && leftWords(run, simulated))].filter(Boolean).join(": "));
    write(about, [simulated ? t("Simulated: no real mill moves") : profile?.description, control && t`${control.operator} has control`].filter(Boolean).join(" · "));
  }
  return { node, update };
}

/** The fault in one line, or its remedy; the mill's own screen has the details. */
function whyWords(machine) {
  if (machine.problem) return sentence(machine.problem);
  return machine.agent.reachable ? millWords(machine.mill).brief : outOfReach(machine);
}

function empty() {
  return h(
    "div",
    { class: "card stack" },
    h("p", {}, t("No mill is set up on this computer.")),
    h("p", {}, t("Write a file "), h("code", {}, "~/.config/causticmill/machines/my-mill.toml"), t(" that says what your mill is and which port its cable is on:")),
    h("pre", { tabIndex: 0 }, 'extends = "grbl"\ndescription = "the mill by the window"\n[link]\nport = "/dev/serial/by-id/..."'),
    h("p", {}, t("Then start the server again. To try everything without a mill: "), h("code", {}, "causticmill serve --with-simulated-mill"), "."),
  );
}
