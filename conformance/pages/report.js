"use strict";
for (const form of document.querySelectorAll("form.filter")) {
  const rows = [...document.getElementById(form.dataset.for).tBodies[0].rows];
  const filter = () => {
    const words = form.elements.words.value.toLowerCase().split(/\s+/).filter(Boolean);
    const shown = form.elements.shown.value;
    let count = 0;
    for (const row of rows) {
      const text = row.textContent.toLowerCase();
      row.hidden = Boolean(shown && row.dataset.shown !== shown) || !words.every((word) => text.includes(word));
      count += !row.hidden;
    }
    form.querySelector("output").textContent = `${count} of ${rows.length} clauses`;
  };
  form.addEventListener("input", filter);
  form.addEventListener("submit", (event) => event.preventDefault());
  form.hidden = false;
  filter();
  // a link to a clause that is filtered away shows it again, before it leads there
  document.addEventListener("click", (event) => {
    const link = event.target.closest("a[href^='#']");
    const row = link && document.getElementById(decodeURIComponent(link.hash.slice(1)));
    if (row && row.hidden) {
      form.reset();
      filter();
    }
  });
}
