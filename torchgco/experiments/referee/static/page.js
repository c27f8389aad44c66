"use strict";
// Each table: a click on a head sorts by its column, words in the field leave the rows that have all of them.
for (const section of document.querySelectorAll("section")) {
  const body = section.querySelector("tbody"), heads = [...section.querySelectorAll("th")];
  const field = section.querySelector("input"), count = section.querySelector(".count");
  const rows = [...body.rows];
  const key = (row, i) => row.cells[i].dataset.sort ?? row.cells[i].textContent.trim().toLowerCase();

  function show() {
    const words = field.value.toLowerCase().split(/\s+/).filter(Boolean);
    let shown = 0;
    for (const row of rows) {
      const text = row.textContent.toLowerCase();
      row.hidden = !words.every((word) => text.includes(word));
      shown += row.hidden ? 0 : 1;
    }
    count.textContent = `${shown} of ${rows.length} rows`;
  }

  function sort(i) {
    const down = heads[i].getAttribute("aria-sort") === "ascending";
    const number = heads[i].classList.contains("number");
    // What isn't known stands last in both directions.
    const compare = (a, b) => {
      const [x, y] = [key(a, i), key(b, i)];
      if (x === "" || y === "") return (x === "") - (y === "");
      const order = number ? Number(x) - Number(y) : x.localeCompare(y);
      return down ? -order : order;
    };
    heads.forEach((head, j) => head.setAttribute("aria-sort", i !== j ? "none" : down ? "descending" : "ascending"));
    rows.sort(compare).forEach((row) => body.append(row));
  }

  heads.forEach((head, i) => head.querySelector("button").addEventListener("click", () => sort(i)));
  field.addEventListener("input", show);
  show();
}
