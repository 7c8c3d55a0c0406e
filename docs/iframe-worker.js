// A browser starts no worker from a file: a hidden frame runs the worker's script instead, so that the search needs no server.
if (location.protocol === "file:") {
  window.Worker = class extends EventTarget {
    constructor(url) {
      super();
      this.frame = document.body.appendChild(Object.assign(document.createElement("iframe"), { hidden: true }));
      const { contentDocument: page, contentWindow: inside } = this.frame;
      const run = source =>
        new Promise((done, failed) => {
          page.body.append(Object.assign(page.createElement("script"), { src: source, onload: done, onerror: failed }));
        });
      inside.importScripts = (...sources) => sources.reduce((before, source) => before.then(() => run(source)), Promise.resolve());
      inside.postMessage = data => this.dispatchEvent(new MessageEvent("message", { data }));
      this.ready = run(url);
    }

    postMessage(data) {
      this.ready.then(() => this.frame.contentWindow.dispatchEvent(new MessageEvent("message", { data })));
    }

    terminate() {
      this.frame.remove();
    }
  };
}
