/* Search of the documentation, without a network and without a server.

   A page that is opened from disk may start no worker and fetch nothing, so lunr and the index (search_index.js, which
   docs_site.py writes) are loaded as plain scripts, when the search is opened for the first time. */
(function () {
  'use strict';
  const folder = document.currentScript.src.replace(/main\.js.*$/, '');
  const MOST = 25, AROUND = 90;
  let index = null, sections = [], loading = null;

  function load(name) {
    return new Promise(function (done, failed) {
      const script = document.createElement('script');
      script.src = folder + name;
      script.onload = done;
      script.onerror = failed;
      document.head.appendChild(script);
    });
  }

  function ready() {
    loading = loading || load('lunr.js').then(function () { return load('search_index.js'); }).then(function () {
      lunr.tokenizer.separator = /[\s\-.,;:()[\]"'`|\/…=<>]+/;
      sections = window.modcal_search_index.docs;
      index = lunr(function () {
        this.ref('at');
        this.field('title', { boost: 8 });
        this.field('text');
        sections.forEach(function (section, at) { this.add({ at: at, title: section.title, text: section.text }); }, this);
      });
    });
    return loading;
  }

  function asked(stems, presence) {
    return index.query(function (query) {
      stems.forEach(function (stem) {
        query.term(stem, { boost: 10, usePipeline: false });
        query.term(stem, { wildcard: lunr.Query.wildcard.TRAILING, presence: presence, usePipeline: false });
      });
    });
  }

  /* Sections with all words, or, where there is none, with any of them. */
  function found(words) {
    const stems = words.filter(function (word) { return lunr.stopWordFilter(new lunr.Token(word)); })
      .map(function (word) { return lunr.stemmer(new lunr.Token(word)).toString(); });
    const all = stems.length ? asked(stems, lunr.Query.presence.REQUIRED) : [];
    const hits = all.length || !stems.length ? all : asked(stems, lunr.Query.presence.OPTIONAL);
    return hits.slice(0, MOST).map(function (hit) { return sections[Number(hit.ref)]; });
  }

  function excerpt(text, words) {
    const low = text.toLowerCase();
    const at = Math.max(0, Math.min.apply(null, words.map(function (word) {
      const place = low.indexOf(word);
      return place < 0 ? text.length : place;
    })));
    const begin = at >= text.length ? 0 : Math.max(0, at - AROUND);
    return (begin ? '…' : '') + text.slice(begin, begin + 3 * AROUND) + (begin + 3 * AROUND < text.length ? '…' : '');
  }

  function show(results, words, box) {
    box.replaceChildren();
    if (words.length && !results.length) {
      box.append(Object.assign(document.createElement('p'), { textContent: 'Nothing found' }));
    }
    results.forEach(function (section) {
      const link = Object.assign(document.createElement('a'), { href: base_url + '/' + section.location, textContent: section.title });
      const heading = document.createElement('h3');
      heading.append(link);
      const article = document.createElement('article');
      article.append(heading, Object.assign(document.createElement('p'), { textContent: excerpt(section.text, words) }));
      box.append(article);
    });
  }

  document.addEventListener('DOMContentLoaded', function () {
    const input = document.getElementById('mkdocs-search-query');
    const box = document.getElementById('mkdocs-search-results');
    if (!input || !box) { return; }
    function search() {
      ready().then(function () {
        const words = input.value.toLowerCase().split(/[^\p{L}\p{N}_]+/u).filter(function (word) { return word.length > 1; });
        show(words.length ? found(words) : [], words, box);
      });
    }
    input.addEventListener('input', search);
    input.addEventListener('focus', ready);
    input.form && input.form.addEventListener('submit', function (event) { event.preventDefault(); search(); });
    const asked = new URLSearchParams(window.location.search).get('q');
    if (asked) { input.value = asked; search(); }
  });
}());
