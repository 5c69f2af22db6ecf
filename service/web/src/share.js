// The owner and scopes of the key, and links that give others read access to a scene.
import { byId, copyText, el, notify, confirmButton } from "./dom.js";
import { fetchJson, post, remove, problemText } from "./service.js";

const day = seconds => new Date(seconds * 1000).toLocaleDateString(undefined, { day: "numeric", month: "long", year: "numeric" });

export class SharePanel {
  constructor() {
    this.lift = null;
    byId("share").addEventListener("submit", event => { event.preventDefault(); this.createLink().catch(problem => notify(problemText(problem), true)); });
    byId("copy-share").addEventListener("click", () => copyText(byId("share-link").value));
  }

  // Read the key. The style of the page hides controls that it does not permit.
  async readKey() {
    const { name, scopes, expires } = await fetchJson("/key");
    const canWrite = scopes.includes("write") || scopes.includes("admin");
    document.body.classList.toggle("reader", !canWrite);
    this.canShare = canWrite && name !== null; // without keys the service is open
    byId("whose").hidden = name === null;
    byId("whose").textContent = scopes.includes("shared") ? `Shared with ${name}${expires ? ` until ${day(expires)}` : ""}` : name ?? "";
    return { canWrite };
  }

  async setLift(lift) {
    this.lift = lift;
    byId("sharing").hidden = !(this.canShare && lift);
    byId("share-made").hidden = true;
    this.listLinks([]);
    if (!byId("sharing").hidden) await this.loadLinks();
  }

  async loadLinks() {
    const { id } = this.lift;
    const { shares } = await fetchJson(`/lifts/${id}/shares`);
    if (this.lift?.id === id) this.listLinks(shares);
  }

  listLinks(shares) {
    byId("shares").hidden = !shares.length;
    byId("shares").replaceChildren(...shares.map(({ name, expires, links }) => el("li", {},
      el("span", {}, name, expires ? el("small", { className: "quiet" }, ` until ${day(expires)}`) : ""),
      confirmButton("Revoke", () => remove(links.self).then(() => this.loadLinks())))));
  }

  async createLink() {
    const { links } = await post(`/lifts/${this.lift.id}/shares`, { name: byId("share-name").value.trim() });
    byId("share-link").value = new URL(links.page.replace(/^\//, ""), document.baseURI).href;
    byId("share-made").hidden = false;
    byId("share-name").value = "";
    byId("share-link").select();
    await this.loadLinks();
  }
}
