/* SPDX-License-Identifier: Apache-2.0
 * The search of the site runs in a Worker, which browsers refuse to pages that are opened from a folder (file:).
 * There a hidden frame stands in for it. Named so that the plugin `offline` adds no script of another host. */
if (location.protocol === "file:") {
  const load = (...urls) =>
    urls.reduce(
      (before, url) =>
        before.then(
          () =>
            new Promise((done, failed) => {
              const script = document.createElement("script");
              Object.assign(script, { src: url, onload: done, onerror: failed });
              document.body.appendChild(script);
            }),
        ),
      Promise.resolve(),
    );
  const reply = (data) => parent.postMessage(data, "*");
  window.IFrameWorker = window.Worker = class extends EventTarget { // the search looks for the first name
    constructor(url) {
      super();
      this.frame = document.createElement("iframe");
      this.frame.hidden = true;
      document.body.appendChild(this.frame);
      this.heard = (event) => {
        if (event.source !== this.frame.contentWindow) return;
        this.dispatchEvent(new MessageEvent("message", { data: event.data }));
        if (this.onmessage) this.onmessage(event);
      };
      window.addEventListener("message", this.heard);
      const page = this.frame.contentWindow.document;
      page.open();
      page.write(
        `<body><script>postMessage = ${reply}; importScripts = ${load};</script><script src="${url}"></script></body>`,
      );
      page.close();
      this.ready = new Promise((done) => (this.frame.contentWindow.onload = done));
    }

    postMessage(data) {
      // Not the frame's own function, which is the worker's way to reply.
      this.ready.then(() => window.postMessage.call(this.frame.contentWindow, data, "*"));
    }

    terminate() {
      window.removeEventListener("message", this.heard);
      this.frame.remove();
    }
  };
}
