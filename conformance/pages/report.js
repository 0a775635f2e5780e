"use strict";
for (const form of document.querySelectorAll("form.filter")) {
  const holder = document.getElementById(form.dataset.for);
  const items = [...holder.querySelectorAll(form.dataset.items)].map((item) => {
    const parts = [...item.querySelectorAll(`:scope > :is(${form.dataset.within})`)];
    return { item, text: parts.map((part) => part.textContent.toLowerCase()).join(" ") };
  });
  const of = (link) => {
    const target = document.getElementById(decodeURIComponent(link.hash.slice(1)));
    return target && items.find(({ item }) => item.contains(target));
  };
  // what lists the items is shown as far as they are
  const lines = [...holder.querySelectorAll(".short > li")].map((line) => [line, of(line.querySelector("a"))]);
  const filter = () => {
    const words = form.elements.words.value.toLowerCase().split(/\s+/).filter(Boolean);
    const shown = form.elements.shown.value;
    let count = 0;
    for (const { item, text } of items) {
      item.hidden = Boolean(shown && item.dataset.shown !== shown) || !words.every((word) => text.includes(word));
      count += !item.hidden;
    }
    for (const [line, { item }] of lines) {
      line.hidden = item.hidden;
    }
    form.querySelector("output").textContent = `${count} of ${items.length} ${form.dataset.what}`;
  };
  form.addEventListener("input", filter);
  form.addEventListener("submit", (event) => event.preventDefault());
  form.hidden = false;
  filter();
  // a link to what is filtered away shows it again, before it leads there
  document.addEventListener("click", (event) => {
    const link = event.target.closest("a[href^='#']");
    const found = link && of(link);
    if (found && found.item.hidden) {
      form.reset();
      filter();
    }
  });
}
