// Whose key this is, what it may do, and links that let others look at a scene and ask it.
import { at, copied, el, notify, twice } from "./dom.js";
import { json, post, remove, words } from "./service.js";

const day = seconds => new Date(seconds * 1000).toLocaleDateString(undefined, { day: "numeric", month: "long", year: "numeric" });

export class Share {
  constructor() {
    this.lift = null;
    at("share").addEventListener("submit", event => { event.preventDefault(); this.make().catch(problem => notify(words(problem), true)); });
    at("copy-share").addEventListener("click", () => copied(at("share-link").value));
  }

  // What the key may not do is hidden by the page's style.
  async begin() {
    const { name, scopes, expires } = await json("/key");
    const changes = scopes.includes("write") || scopes.includes("admin");
    document.body.classList.toggle("reader", !changes);
    this.may = changes && name !== null; // without keys there is nobody to keep out
    at("whose").hidden = name === null;
    at("whose").textContent = scopes.includes("shared") ? `Shared with ${name}${expires ? ` until ${day(expires)}` : ""}` : name ?? "";
    return { changes, shared: scopes.includes("shared") };
  }

  async of(lift) {
    this.lift = lift;
    at("sharing").hidden = !(this.may && lift);
    at("share-made").hidden = true;
    this.show([]);
    if (!at("sharing").hidden) await this.list();
  }

  async list() {
    const { id } = this.lift;
    const { shares } = await json(`/lifts/${id}/shares`);
    if (this.lift?.id === id) this.show(shares);
  }

  show(shares) {
    at("shares").hidden = !shares.length;
    at("shares").replaceChildren(...shares.map(({ name, expires, links }) => el("li", {},
      el("span", {}, name, expires ? el("small", { className: "quiet" }, ` until ${day(expires)}`) : ""),
      twice("End it", () => remove(links.self).then(() => this.list())))));
  }

  async make() {
    const { links } = await post(`/lifts/${this.lift.id}/shares`, { name: at("share-name").value.trim() });
    at("share-link").value = new URL(links.page.replace(/^\//, ""), document.baseURI).href;
    at("share-made").hidden = false;
    at("share-name").value = "";
    at("share-link").select();
    await this.list();
  }
}
