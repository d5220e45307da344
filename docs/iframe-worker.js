// SPDX-License-Identifier: Apache-2.0
// Search without a server: browsers refuse workers of file:// pages, so the script of the worker
// runs in a hidden frame instead, with the same messages to and fro. Nothing is loaded from a
// network. Only used where the page itself is a file.
if (location.protocol === 'file:') {
  window.Worker = class extends EventTarget {
    constructor(url) {
      super();
      this.frame = document.createElement('iframe');
      this.frame.hidden = true;
      document.body.appendChild(this.frame);
      const inner = this.frame.contentWindow;
      window.addEventListener('message', (event) => {
        if (event.source !== inner) return;
        const message = new MessageEvent('message', { data: event.data });
        this.dispatchEvent(message);
        if (this.onmessage) this.onmessage(message);
      });
      inner.document.open();
      inner.document.write(
        '<!doctype html><html><body><script>' +
          'postMessage = function (data) { parent.dispatchEvent(' +
          "new MessageEvent('message', { data: data, source: window })); };" +
          'importScripts = function () {' +
          '  return [].slice.call(arguments).reduce(function (before, source) {' +
          '    return before.then(function () {' +
          '      return new Promise(function (done) {' +
          "        var script = document.createElement('script');" +
          '        script.src = source; script.onload = done;' +
          '        document.body.appendChild(script);' +
          '      });' +
          '    });' +
          '  }, Promise.resolve());' +
          '};' +
          '<' + '/script><script src="' + url + '"><' + '/script></body></html>'
      );
      inner.document.close();
      this.ready = new Promise((done) => { inner.onload = done; });
    }

    postMessage(data) {
      const inner = this.frame.contentWindow;
      this.ready.then(() => inner.dispatchEvent(new MessageEvent('message', { data })));
    }

    terminate() {
      this.frame.remove();
    }
  };
}
