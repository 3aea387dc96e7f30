// Show one section at a time, draw the page's figures with Plotly, and keep a served page up to date.
"use strict";

const dark = matchMedia("(prefers-color-scheme: dark)");

const values = (block) => block.querySelector("script[type='application/json']");
const read = (block) => JSON.parse(values(block).textContent);

function draw(block) {
  const figure = read(block);
  const style = getComputedStyle(document.documentElement);
  const [ink, line] = ["--ink", "--line"].map((name) => style.getPropertyValue(name).trim());
  const layout = {
    ...figure.layout, paper_bgcolor: "rgba(0,0,0,0)", plot_bgcolor: "rgba(0,0,0,0)", font: { color: ink },
    legend: { ...figure.layout.legend, bgcolor: "rgba(0,0,0,0)" },
  };
  for (const axis of ["xaxis", "yaxis"]) {
    layout[axis] = { gridcolor: line, zerolinecolor: line, linecolor: line, ...layout[axis] };
  }
  const options = { responsive: true, displaylogo: false, displayModeBar: false };
  return Plotly.react(block.querySelector(".plot"), figure.data, layout, options);
}

const drawn = new IntersectionObserver((seen) => {
  for (const { isIntersecting, target } of seen) {
    if (isIntersecting) {
      drawn.unobserve(target); // once: later changes are drawn when they arrive
      target.dataset.drawn = "yes";
      draw(target).then((plot) => plot.on("plotly_click", ({ points }) => choose(target, points[0])));
    }
  }
}, { rootMargin: "600px" });

function watch(root) {
  root.querySelectorAll("figure.chart").forEach((figure) => drawn.observe(figure));
}

// A click on a figure's cell chooses its pair in the lists that follow the figure.
function choose(figure, { x, y }) {
  const pairs = figure.parentElement.querySelector(".pairs");
  if (!pairs) return;
  [y, x].forEach((name, i) => { pairs.querySelectorAll("select")[i].value = name; });
  showPair(pairs);
  pairs.scrollIntoView({ block: "nearest" });
}

function made(tag, ...inside) {
  const element = document.createElement(tag);
  element.append(...inside);
  return element;
}

function copying(command) {
  const button = made("button", command);
  Object.assign(button, { type: "button", className: "copy" });
  return button;
}

function leading(to, text) {
  return Object.assign(made("a", text), { href: to, target: "_blank", rel: "noopener" });
}

function showPair(pairs) {
  const [a, b] = [...pairs.querySelectorAll("select")].map((list) => list.value);
  const { heads, found, led } = read(pairs);
  const of = (one, other) => found[one]?.[other] ?? [];
  const rows = (a === b ? of(a, b) : [...of(a, b), ...of(b, a)]).sort((one, other) => other[0] - one[0]);
  const cell = (row) => (text, i) => {
    if (i === row.length - 1) return text && copying(text);
    return i === 0 && led && row.at(-1) ? leading(led + text, text) : text;
  };
  const line = (row) => made("tr", ...row.map(cell(row)).map((inside) => made("td", inside)));
  const titles = made("thead", made("tr", ...heads.map((head) => Object.assign(made("th", head), { scope: "col" }))));
  const caption = `${a} and ${b}: ${rows.length || "no"} ${rows.length === 1 ? "batch" : "batches"}`;
  const table = made("table", made("caption", caption), titles, made("tbody", ...rows.map(line)));
  const shown = pairs.querySelector(".rows");
  shown.hidden = !a || !b;
  if (!same(shown, made("div", table))) shown.replaceChildren(table); // avoids that a screen reader repeats it
}

async function copy(button) {
  const state = document.getElementById("state");
  try {
    await navigator.clipboard.writeText(button.textContent);
    state.textContent = `Copied: ${button.textContent}`;
  } catch {
    getSelection().selectAllChildren(button);
    state.textContent = "This browser lets no page copy: the command is selected.";
  }
}

function redraw() {
  document.querySelectorAll("figure[data-drawn]").forEach(draw);
}

const sections = () => [...document.querySelectorAll("main > section")];

function named() {
  return document.getElementById(decodeURIComponent(location.hash.slice(1)));
}

// Hidden sections are found by the browser's own search where it can do that. Without this script all are shown.
function showOnly(section) {
  document.body.classList.add("tabbed");
  sections().forEach((each) => (each === section ? each.removeAttribute("hidden") : each.setAttribute("hidden", "until-found")));
  document.querySelectorAll("nav a").forEach((link) => {
    const current = link.hash === `#${section.id}`;
    if (!current) return link.removeAttribute("aria-current");
    link.setAttribute("aria-current", "true");
    const list = link.closest("ul");
    list.scrollLeft = link.offsetLeft - (list.clientWidth - link.offsetWidth) / 2;
  });
  // The window may have changed while they were hidden.
  section.querySelectorAll("figure[data-drawn] .plot").forEach((plot) => Plotly.Plots.resize(plot));
}

function shown() {
  return sections().find((section) => !section.hidden) ?? sections()[0];
}

// The section of the address; an address outside all of them, such as the skip link's, leaves what is shown.
function navigate() {
  const target = named(), section = target?.closest("main > section");
  if (!section) return location.hash.length < 2 && showOnly(sections()[0]);
  showOnly(section);
  if (target !== section) return target.scrollIntoView();
  section.tabIndex = -1; // the next Tab goes on from here, and a screen reader reads its name
  section.focus({ preventScroll: true });
  scrollTo(0, 0);
}

function same(a, b) {
  return (a && a.innerHTML) === (b && b.innerHTML);
}

// Row by row, since most of a thousand rows stay unchanged.
function changeRows(old, fresh) {
  const rows = [...old.rows], newer = [...fresh.rows];
  newer.forEach((row, i) => {
    if (i >= rows.length) old.append(document.adoptNode(row));
    else if (!same(rows[i], row)) rows[i].innerHTML = row.innerHTML;
  });
  rows.slice(newer.length).forEach((row) => row.remove());
}

function changeTable(old, fresh) {
  const table = old.querySelector("table");
  if (table && same(table.caption, fresh.querySelector("caption")) && same(table.tHead, fresh.querySelector("thead"))) {
    changeRows(table.tBodies[0], fresh.querySelector("tbody"));
  } else if (!same(old, fresh)) {
    old.innerHTML = fresh.innerHTML;
  }
}

function changePairs(old, fresh) {
  const newer = fresh.querySelectorAll("select");
  old.querySelectorAll("select").forEach((list, i) => {
    if (list.textContent === newer[i].textContent) return;
    const chosen = list.value;
    list.innerHTML = newer[i].innerHTML;
    list.value = chosen;
  });
  showPair(old);
}

// A film that plays is left to its viewer until the page changes again.
function changeFilm(old, fresh) {
  const film = old.querySelector("video");
  if (!same(old, fresh) && !(film && !film.paused)) old.innerHTML = fresh.innerHTML;
}

// Only changed elements are updated, and no block is replaced, to keep focus and scroll positions.
function change(old, fresh) {
  if (old.matches(".film")) return changeFilm(old, fresh);
  if (old.matches(".card")) old.className = fresh.className;
  if (!values(old)) return changeTable(old, fresh);
  const changed = values(old).textContent !== values(fresh).textContent;
  values(old).textContent = values(fresh).textContent;
  if (old.matches(".pairs")) return changePairs(old, fresh);
  old.querySelector("figcaption").textContent = fresh.querySelector("figcaption").textContent;
  if (changed && old.dataset.drawn) draw(old);
}

function update(text) {
  const fresh = new DOMParser().parseFromString(text, "text/html"), current = shown().id;
  for (const section of fresh.querySelectorAll("section")) {
    const old = document.getElementById(section.id);
    const ids = (of) => [...of.querySelectorAll("[data-block]")].map((block) => block.id).join();
    if (ids(old) === ids(section)) {
      section.querySelectorAll("[data-block]").forEach((block) => change(document.getElementById(block.id), block));
    } else {
      old.querySelectorAll(".plot").forEach((plot) => Plotly.purge(plot));
      old.replaceWith(document.adoptNode(section));
      watch(document.getElementById(section.id));
    }
  }
  showOnly(document.getElementById(current));
}

// Without a name the server shows the league that was run last, which may be another one by now.
function name(title) {
  if (document.title !== title) document.title = document.querySelector("h1").textContent = title;
}

function follow() {
  const state = document.getElementById("state");
  const main = document.querySelector("main");
  const tell = (text) => { if (state.textContent !== text) state.textContent = text; };
  let busy = false;
  let wanted = main.dataset.version;

  async function fetched() {
    if (busy) return;
    busy = true;
    try {
      while (wanted !== main.dataset.version) {
        const answer = await fetch("main", { cache: "no-store" });
        if (!answer.ok) throw new Error(answer.statusText);
        update(await answer.text());
        name(decodeURIComponent(answer.headers.get("X-Title")));
        main.dataset.version = answer.headers.get("X-Version");
        if (main.dataset.version !== wanted) await new Promise((done) => setTimeout(done, 500));
      }
      tell("Up to date.");
    } catch {
      tell("The league cannot be read now; trying again.");
      setTimeout(fetched, 2000);
    } finally {
      busy = false;
    }
  }

  function listen() {
    const events = new EventSource("events");
    events.addEventListener("revision", (event) => { wanted = event.data; fetched(); });
    events.addEventListener("trouble", (event) => tell(event.data));
    events.onerror = () => {
      tell("The server does not answer; the page goes on when it does.");
      events.close(); // browsers differ in when they give up, so reconnect here
      setTimeout(listen, 1000);
    };
  }
  listen();
}

addEventListener("change", ({ target }) => target.matches(".pairs select") && showPair(target.closest(".pairs")));
addEventListener("click", ({ target }) => target.matches("button.copy") && copy(target));
dark.addEventListener("change", redraw);
let printed;
addEventListener("beforeprint", () => {
  printed = shown();
  sections().forEach((section) => section.removeAttribute("hidden"));
  document.querySelectorAll("figure.chart").forEach((figure) => {
    figure.dataset.drawn = "yes";
    draw(figure);
  });
});
addEventListener("afterprint", () => showOnly(printed));
addEventListener("hashchange", navigate);
addEventListener("beforematch", ({ target }) => showOnly(target.closest("main > section")));
showOnly(named()?.closest("main > section") ?? sections()[0]);
watch(document);
if (document.body.dataset.live) follow();
